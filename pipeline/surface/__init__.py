"""Turn observed points into a surface: triangulated grids, fused depth maps, several stations, Poisson reconstruction.

Surfaces are compared in `pipeline/change`. Start with `reconstruct.py`.
"""

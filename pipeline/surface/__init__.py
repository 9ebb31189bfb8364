"""Turn observed points into a surface: triangulated grids, fused depth maps, several stations, Poisson reconstruction.

Comparing surfaces is the work of `pipeline/change`.
Start with `reconstruct.py`.
"""

"""Read and write point clouds: LAS and LAZ, COPC, E57, PCD, PTX and text.

PLY files, which may also contain a mesh, are in `pipeline/formats/meshes`. Start with `points.py`, which chooses the reader; each
reader returns the `PointCloud` of `pipeline/formats/point_cloud.py`.
"""

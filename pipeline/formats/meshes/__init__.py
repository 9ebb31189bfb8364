"""Read and write meshes as PLY and binary glTF.

Mesh files of walls, in any format that trimesh reads, are read by `scene/walls/imported.py`. Start with `ply.py`.
"""

"""Read and write meshes as PLY and binary glTF.

The wall's own mesh files, in any format that trimesh reads, are read by `scene/walls/imported.py`.
Start with `ply.py`.
"""

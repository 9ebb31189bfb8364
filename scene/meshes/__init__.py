"""Read mesh files and repair meshes: weld vertices, orient faces, detect rounded coordinates.

The mesh itself is defined in `scene/geometry/mesh.py`; which file becomes a wall is decided in `scene/walls/imported.py`.
Start with `cleaning.py`, the sequence of all repairs, and `winding.py`, which decides the outer side of a surface.
"""

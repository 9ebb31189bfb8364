"""Define the data structures that all geometry shares: the triangle mesh, the wall frame, the raster grid.

Reading, repairing and ray casting of meshes have folders of their own (`scene/meshes`, `scene/ray_casting`). Start with
`mesh.py`; `frame.py` states the axes and the origin of the wall frame.
"""

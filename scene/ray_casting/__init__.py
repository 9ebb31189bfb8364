"""Trace rays against a triangle mesh with Mitsuba and recompute the hits in double precision.

The sensors observe the scene through this folder; what they make of a hit is in `sensors`. Start with `RayCaster` in
`raycast.py`. `rasterise.py` draws a mesh on a raster without rays; `upload.py` copies NumPy arrays to the device.
"""

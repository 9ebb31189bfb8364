"""Trace rays against a triangle mesh with Mitsuba and compute the hits again in double precision.

The sensors use this folder to see the scene; what they do with a hit is in `sensors`.
Start with `RayCaster` in `raycast.py`; `upload.py` copies NumPy arrays to the device.
"""

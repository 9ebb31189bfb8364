"""Compute what the rock looks like: its texture, wet patches, and the light of sun and sky.

Only rendered photographs and the laser's reflectance need it; the geometry of the wall is in `scene/walls`.
Start with `texture.py`.
"""

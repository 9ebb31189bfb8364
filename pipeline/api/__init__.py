"""Offer the program as Python functions: what `from pipeline import ...` gives.

Results are the field's own types: NumPy and xarray arrays, GeoDataFrames, meshes.
Start with `runs.py` (`simulate`, `open_run`).
"""

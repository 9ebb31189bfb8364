"""Provide the program as Python functions: what `from pipeline import ...` gives.

Results have the types that the field uses: NumPy and xarray arrays, GeoDataFrames, meshes. Start with `runs.py` (`simulate`,
`open_run`).
"""

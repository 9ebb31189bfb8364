"""Read and write rasters as TIFF and GeoTIFF, and the style with which QGIS shows them.

Difference maps are computed in `pipeline/change`.
Start with `geotiff.py`.
"""

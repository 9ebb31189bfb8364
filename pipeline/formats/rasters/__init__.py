"""Read and write rasters as TIFF and GeoTIFF, and the style in which QGIS shows them.

Difference maps are computed in `pipeline/change`. Start with `geotiff.py`.
"""

"""Read and write every file format, one module a format, reader and writer side by side.

What is done with the content is in the other folders of `pipeline`; meshes that become walls are read by `scene/walls`.
Start with the subfolder of the kind of data: points, rasters, meshes, cameras, records, measurements.
The subfolder `files` holds what all writers share.
"""

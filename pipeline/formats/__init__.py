"""Read and write all file formats, one module for each format, with reader and writer side by side.

What is done with the content is in the other folders of `pipeline`; meshes that become walls are read by `scene/walls`. Start
with the subfolder of the kind of data: points, rasters, meshes, cameras, records, measurements. `files` has what all writers
share.
"""

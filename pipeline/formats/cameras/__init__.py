"""Read and write camera calibrations and poses: Metashape, COLMAP, OpenCV and the project's own YAML.

The camera model itself is in `sensors/cameras`. Start with `camera_files.py`, which recognises the format and selects the pair.
"""

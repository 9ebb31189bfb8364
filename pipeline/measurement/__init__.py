"""Build a measurement folder from raw scans or photogrammetric clouds and a reference (`scarpsim measurement`).

Reading such a folder is the task of `pipeline/formats/measurements`. Start with `build.py`.
"""

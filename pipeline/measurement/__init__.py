"""Build a measurement folder from raw scans, photographs and a reference (`scarpsim measurement`).

Reading such a folder is the work of `pipeline/formats/measurements`.
Start with `build.py`.
"""

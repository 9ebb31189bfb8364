"""Read and write records: COCO annotations, run.json, gap.json, the files of a run folder, and GeoPackage tables.

What their numbers mean is decided where they are computed. Start with `coco.py` for annotations or `run_files.py` for a run
folder.
"""

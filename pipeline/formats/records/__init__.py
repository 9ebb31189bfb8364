"""Read and write the records beside the data: COCO annotations, run.json, gap.json and the files of a run folder.

What the numbers in them mean is decided where they are computed.
Start with `coco.py` for annotations or `run_files.py` for a run folder.
"""

"""Compare real epochs of a wall and list what fell (`scarpsim monitor`).

Readers of files are in `pipeline/formats`, the search for the sensor's place in `pipeline/measurement`, detectors in
`pipeline/detection`. Start with `run.py`, which goes from files to events; each step has a module of its own.
"""

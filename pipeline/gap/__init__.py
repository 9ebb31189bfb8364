"""Find the sensor effect that a simulation lacks, by comparing it with a measurement (`scarpsim gap`).

The effects themselves are in `sensors/effects`; fitting only the noise is the work of `pipeline/calibration`.
Start with `naming/workflow.py`, the sequence of all steps; `thresholds.py` holds every threshold with its reason.
"""

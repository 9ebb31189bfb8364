"""Compute the residuals of a measurement: what was measured minus what the current model predicts along the same rays.

`residuals.py` has the common class; `tls_residuals.py`, `stereo_residuals.py` and `surface_residuals.py` compute it for each
sensor; `alignment.py` aligns the sensor with the reference first; `scene_changes.py` sets regions that moved aside.
"""

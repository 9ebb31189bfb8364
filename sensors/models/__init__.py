"""Describe a sensor as a config or a measurement's model.yaml does: its base noise, its effects, and where it stands.

Presets of instruments are in `sensors/laser/presets.py`; the sensors themselves are in `sensors/laser` and `sensors/stereo`.
Start with `sensor_model.py`.
"""

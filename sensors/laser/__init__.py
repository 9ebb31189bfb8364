"""Simulate the terrestrial laser scanner: its pattern of pulses, both faces, presets from data sheets, the air.

Errors and noise of the scanner are effects, one file each in `sensors/effects`.
Start with `Scanner` in `tls.py`.
"""

"""Simulate the terrestrial laser scanner: its pattern of pulses, both faces, presets from data sheets, the atmosphere.

Errors and noise of the scanner are effects, one file each in `sensors/effects`. Start with `LaserScanner` in `tls.py`.
"""

"""Provide numerical tools for the sensors: functions on host and device, vector algebra, linear interpolation.

Nothing here depends on a camera or a scanner. Start with `functions.py`, which lets each equation be written once for NumPy
and Dr.Jit.
"""

"""Hold the small numerical tools of the sensors: functions on host and device, vector algebra, linear interpolation.

Nothing here knows a camera or a scanner.
Start with `functions.py`, which lets each equation be written once for NumPy and Dr.Jit.
"""

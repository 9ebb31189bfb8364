"""Define the data that pass along a sensor's chain of stages: laser pulses, beams, returns, matched pixels, and the observation.

Effects (`sensors/effects`) change these objects; the sensors (`sensors/laser`, `sensors/stereo`) create them and run the
chain. Start with `observation.py`, the result of every sensor, then `pulses.py` or `matches.py`.
"""

"""Define what passes along a sensor's chain of stages: laser pulses and beams, matched pixels, returns, and the observation.

Effects (`sensors/effects`) change these objects; the sensors (`sensors/laser`, `sensors/stereo`) make them and run the chain.
Start with `observation.py`, the result of every sensor, then `pulses.py` or `matches.py`.
"""

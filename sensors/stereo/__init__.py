"""Simulate the stereo pair: disparities by ray tracing, by matching rendered photographs, or vertex by vertex.

The camera model is in `sensors/cameras`; errors of cameras and matching are effects in `sensors/effects`. Start with
`stereo_pair.py`, the pair whose matching is simulated; the other modules are its variants and steps.
"""

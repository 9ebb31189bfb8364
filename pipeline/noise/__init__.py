"""Describe the noise of difference maps: robust statistics, semivariograms, measured against simulated.

`pipeline/calibration` and `pipeline/comparison` use it; the noise of a sensor is defined in `sensors/effects`. Start with
`statistics.py`.
"""

"""Fit the noise parameters of a sensor model to measured difference maps (`scarpsim calibrate`).

The fit compares the size of the noise and its spatial pattern. Finding an effect that the model lacks is the task of
`pipeline/gap`. Start with `calibrate.py`.
"""

"""Fit the noise of a sensor model to measured difference maps, in size and in pattern (`scarpsim calibrate`).

Naming an effect that the model lacks is the work of `pipeline/gap`.
Start with `calibrate.py`.
"""

"""Fit the systematic effects: the mean model of the residuals, its candidates and their selection.

Noise, edges and missing returns are in `pipeline/gap/noise_and_edges`; the order of all fits is decided in `pipeline/gap/naming`.
Start with `selection.py`.
"""

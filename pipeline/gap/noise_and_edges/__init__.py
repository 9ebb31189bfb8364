"""Fit what is no systematic effect: the variance model, grid-correlated noise, edge effects, missing returns, rounding and
locking.

Systematic effects are in `pipeline/gap/mean`. Start with the module named after the effect in question.
"""

"""Fit everything that is not a systematic effect of the mean.

This comprises the variance model, grid-correlated noise, edge effects, missing returns, rounding and pixel locking. Systematic
effects are in `pipeline/gap/mean`. Start with the module named after the effect in question.
"""

"""Fit what is no systematic effect: variance models, edge effects, missing returns, quantisation.

Systematic effects are in `pipeline/gap/mean`.
Start with the module named after the effect in question.
"""

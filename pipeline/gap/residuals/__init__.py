"""Compute the residuals: the measurement minus what the current model predicts along the same rays or at the same pixels.

Everything that explains them is in the folders beside this one.
Start with `residuals.py`.
"""

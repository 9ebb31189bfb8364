"""Predict what a sensor achieves at a place on the wall from geometry alone: spacing, precision, smallest detectable block.

The maps are made by `pipeline/planning`. Start with `detectability.py`.
"""

"""Predict, from geometry alone, what a sensor achieves at a place of the wall: spacing, precision, smallest detectable block.

Maps of it are drawn by `pipeline/planning`.
Start with `detectability.py`.
"""

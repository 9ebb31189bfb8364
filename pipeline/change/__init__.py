"""Compute change: difference rasters, M3C2 distances, tiles, annotations of carved blocks.

Registration comes before (`pipeline/registration`), detection after (`pipeline/detection`). Start with `difference.py`.
"""

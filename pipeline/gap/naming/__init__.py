"""Decide which effects are named, and in which order they are fitted.

The fits themselves are in `pipeline/gap/mean` and `pipeline/gap/noise_and_edges`.
Start with `workflow.py`.
"""

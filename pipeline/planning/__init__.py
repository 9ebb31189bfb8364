"""Plan a survey: maps of point spacing, precision and the smallest detectable block (`scarpsim inspect`).

The formulas for one place on the wall are in `pipeline/precision`. Start with `inspect.py`.
"""

"""Plan a survey: maps of point spacing, precision and the smallest detectable block (`scarpsim inspect`).

The formulas at one place of the wall are in `pipeline/precision`.
Start with `inspect.py`.
"""

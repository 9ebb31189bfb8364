"""Compute, before any data are read, which effects a measurement of this geometry can tell apart.

It also proposes the additional measurement that would separate two effects that look alike here.
Start with `identifiability.py`, then `surveys.py`.
"""

"""Evaluate `scarpsim gap` by a second generator, which was written from the specification only.

It makes folders with hidden truth, and their scores.
"""

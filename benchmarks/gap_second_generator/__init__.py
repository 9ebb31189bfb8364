"""A second generator for evaluating `scarpsim gap`, written from the specification only: folders with hidden truth, and their
scores.
"""

"""Compare sensors on the same wall and the same blocks: their noise, and which blocks each detects (`scarpsim compare`).

Planning a single survey is the task of `pipeline/planning`. Start with `comparison.py`.
"""

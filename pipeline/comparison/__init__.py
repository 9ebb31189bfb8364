"""Compare sensors on the same wall and the same blocks: noise maps and the share of blocks each detects (`scarpsim compare`).

Planning one survey is the work of `pipeline/planning`.
Start with `comparison.py`.
"""

"""Draw the rock blocks that fall, and carve them out of the wall with Manifold.

How many blocks fall in which epoch is decided by the run (`pipeline/run`). Start with `block.py` (shape, size and placement)
and `carve.py` (the boolean operations and their results).
"""

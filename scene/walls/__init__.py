"""Make the rock wall: procedural walls in the style of known sites, and walls read from mesh files.

Blocks that fall from a wall are in `scene/blocks`, its illumination in `scene/appearance`. Start with `wall.py`, which a run
calls; `safe_zone.py` decides where on a wall blocks may be placed.
"""

"""Run one simulation: site, epochs, products and report of a run folder (`simulate`).

The sensors are in `sensors`, the wall and its blocks in `scene`. Start with `simulation.py`, then `epoch.py`, which reads from
top to bottom.
"""

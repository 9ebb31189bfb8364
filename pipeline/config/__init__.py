"""Define the simulation config, its presets and overrides, and the commented config that `scarpsim init` writes.

The model of each section is defined beside the code that it configures. Start with `simulation.py`.
"""

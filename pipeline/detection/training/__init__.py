"""Train the detector: steps, validation, checkpoints and early stopping; also with all data in a graphics card's memory.

The network and its losses are in `pipeline/detection/network`. Start with `training.py`.
"""

"""Train the detector: steps, validation, checkpoints, early stop, and training with all data in an accelerator's memory.

The network and its losses are in `pipeline/detection/network`.
Start with `training.py`.
"""

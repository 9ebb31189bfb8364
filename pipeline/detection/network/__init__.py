"""Build Mask R-CNN in Keras 3: backbone, heads, anchors, targets, losses, and its input from difference maps.

Running it over whole maps is in `pipeline/detection/inference`, fitting it in `pipeline/detection/training`.
Start with `model.py`.
"""

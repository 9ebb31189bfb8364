"""Build Mask R-CNN in Keras 3: backbone, heads, anchors, targets, losses, and its input from difference maps.

`pipeline/detection/inference` applies it to whole maps, `pipeline/detection/training` trains it. Start with `model.py`.
"""

"""Detect rockfall in difference maps with Mask R-CNN in Keras, train it, and score detections against the truth.

Making the training data is the work of `pipeline/dataset`.
Start with `products/run.py` (`scarpsim detect`), then `inference`, `network`, `training`, `evaluation`.
"""

"""Detect rockfall in difference maps with Mask R-CNN in Keras, train the network, and score detections against the truth.

Training data is made by `pipeline/dataset`. Start with `products/run.py` (`scarpsim detect`), then `inference`, `network`,
`training` and `evaluation`.
"""

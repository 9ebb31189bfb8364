"""Find blocks in whole difference maps: tiles, seams, mirrored views, the threshold detector, and trained weights on disk.

The network itself is in `pipeline/detection/network`.
Start with `inference.py`.
"""

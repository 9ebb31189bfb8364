"""Compare detections with the truth: matching, precision, recall, F1, and the reliability of scores.

Tables for the user are written by `pipeline/detection/products`. Start with `evaluate.py`.
"""

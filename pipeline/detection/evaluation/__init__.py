"""Compare detections with the truth: matching, precision, recall, F1, and how reliable a score is.

Writing tables for the user is in `pipeline/detection/products`.
Start with `evaluate.py`.
"""

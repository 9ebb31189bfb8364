"""Register a surface to a reference with ICP.

What is compared afterwards is in `pipeline/change`. Start with `register.py`.
"""

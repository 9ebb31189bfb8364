"""Register a surface on a reference with ICP.

What is compared afterwards is in `pipeline/change`.
Start with `register.py`.
"""

"""Show run folders, data sets and results of `gap` in a browser (`scarpsim view`).

Static reports are written by each command itself. Start with `server.py` and `page.py`.
"""

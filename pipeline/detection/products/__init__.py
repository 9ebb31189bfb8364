"""Write what `scarpsim detect` and `scarpsim evaluate` give to the user: events, masks, tables and figures.

The detection itself is in `pipeline/detection/inference`.
Start with `run.py` and `score_files.py`.
"""

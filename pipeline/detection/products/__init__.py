"""Write the results of `scarpsim detect` and `scarpsim evaluate`: events, masks, tables and figures.

Detection itself is in `pipeline/detection/inference`. Start with `run.py` and `score_files.py`.
"""

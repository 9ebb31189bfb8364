"""Make labelled training sets from many simulated epochs, on several processes (`scarpsim dataset`).

A single epoch is simulated by `pipeline/run`; training is in `pipeline/detection`. Start with `run.py`; `plan.py` lists the
epochs that a config asks for.
"""

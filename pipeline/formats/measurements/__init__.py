"""Read and check a measurement folder: points, reference surface, instrument and sensor model.

Building such a folder from raw files is the task of `pipeline/measurement`. Start with `measurement.py`; `config.py` lists the
keys of measurement.yaml.
"""

"""Study how ICP's result depends on its subsample ratio and its outlier threshold (`scarpsim icp-study`).

The ICP itself is in `pipeline/registration`. Start with `study.py`.
"""

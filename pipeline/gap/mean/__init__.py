"""Find the systematic effects: the mean model of the residuals, its candidate effects, and their selection.

`selection.py` has the forward selection, `search.py` scores the candidates for it, and `mean_model.py` the regression behind.
Noise, edge effects and missing returns are in `pipeline/gap/noise_and_edges`; `pipeline/gap/naming` orders the fits.
"""

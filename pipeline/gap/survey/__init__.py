"""Compute, before there are data, which effects a planned survey can detect and distinguish.

It also proposes the additional measurement that would separate two effects with similar signatures.
`identifiability.py` has the analysis; `load_surveys.py` reads the survey, and `survey_views.py` describes it.
"""

"""Write files safely: completely or not at all, by one writer at a time, in their own folder; checksums and XML of other
programs.

Formats themselves are in the other subfolders of `pipeline/formats`. Start with `atomic.py`.
"""

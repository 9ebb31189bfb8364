"""Write files safely: completely or not at all, by one writer at a time, in their own folder.

Checksums and the reading of other programs' XML are here too. Formats themselves are in the other subfolders of
`pipeline/formats`. Start with `atomic.py`.
"""

"""Hold what all readers and writers share: atomic files, checksums, locks, safe XML and safe names.

Nothing here knows what a file contains.
Start with `atomic.py`: every product is written under a temporary name and then renamed.
"""

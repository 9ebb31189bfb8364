"""Hold what all reports share: page template, figures, progress line, provenance.

The content of a report stands beside the command that writes it.
Start with `page.py`.
"""

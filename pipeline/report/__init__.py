"""Provide what all reports share: page template, figures, progress, provenance.

The content of a report is defined beside the command that writes it. Start with `page.py`.
"""

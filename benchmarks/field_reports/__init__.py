"""Files of the kinds that public reports say broke other programs, and what this program does with each."""

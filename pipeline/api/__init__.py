"""What `from pipeline import ...` gives: the uses of the program as functions, their results as the field's own types."""

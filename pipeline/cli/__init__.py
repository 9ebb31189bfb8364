"""Parse the command line and call the program: one thin module per command.

No module here computes results; those come from the other folders of `pipeline`. Start with `main.py`.
"""

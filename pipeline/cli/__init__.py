"""Parse the command line and call the API: one thin module a command.

No module here computes anything; results come from the other folders of `pipeline`.
Start with `main.py`.
"""

"""Hold what every part of the program uses and that is no scene: errors, config models, random numbers, threads, lazy imports.

Nothing here knows a mesh, a wall or a sensor; `backend.py` is the only module that imports Mitsuba and Dr.Jit.
Start with `errors.py` (how a user's mistake is reported) and `config.py` (the base class of every config section).
"""

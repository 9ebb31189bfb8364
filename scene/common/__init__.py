"""Provide the services that the whole program uses: errors, config models, file reading, random numbers, threads, lazy imports.

Nothing here depends on a mesh, a wall or a sensor; `backend.py` is the only module that imports Mitsuba and Dr.Jit. Start with
`errors.py` (how a user's mistake is reported) and `config.py` (the base class of every config section).
"""

"""Tell how to install an optional part of the program (an extra of the Python package)."""

from __future__ import annotations

from pathlib import Path

_ROOT = Path(__file__).parents[2]


def how_to_install(extra: str) -> str:
    """Return the command that installs an optional group of dependencies, for error messages: `extra` is the group's name.

    The command is `make setup` in a source checkout, and pip elsewhere.
    """
    if (_ROOT / "tools" / "setup.sh").is_file():
        return f"make setup EXTRAS={extra}, in {_ROOT}"
    return f"pip install 'scarpsim[{extra}]'"

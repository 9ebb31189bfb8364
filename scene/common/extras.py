"""How an optional part of the program, an extra of the package, is installed."""

from __future__ import annotations

from pathlib import Path

_ROOT = Path(__file__).parents[2]


def how_to_install(extra: str) -> str:
    """The command that installs an extra: where the program runs from a checkout that of its set-up, else pip's."""
    if (_ROOT / "tools" / "setup.sh").is_file():
        return f"make setup EXTRAS={extra}, in {_ROOT}"
    return f"pip install 'scarpsim[{extra}]'"

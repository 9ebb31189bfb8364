"""The page of commands: what `--help` of each says."""

from __future__ import annotations

import contextlib
import io
import os

from pipeline.cli.main import COMMANDS, main

_INTRODUCTION = """# Commands

What `--help` says of each command. `simulate` alone is the same as `scarpsim simulate`.

| exit code | meaning |
|---|---|
| 0 | done |
| 2 | the input or the config is wrong: one message says what, where, what is allowed and how to mend it |
| 1 | anything else; the message names the file with the traceback |
| 130 | interrupted; what was finished is kept and usable |
"""
_COLUMNS = "88"


def pages() -> dict[str, str]:
    """One page."""
    parts = [_INTRODUCTION, *(f"## scarpsim {name}\n\n```text\n{_help(name)}\n```" for name in COMMANDS)]
    return {"reference/commands.md": "\n\n".join(parts) + "\n"}


def _help(name: str) -> str:
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _COLUMNS
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            code = main([name, "--help"])
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    assert code == 0, f"scarpsim {name} --help: exit code {code}"
    return printed.getvalue().strip()

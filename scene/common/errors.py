"""The error that a person can mend, wrong input or a wrong config; and the one that lies outside of the program."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Wrong input: what is wrong and where, what is allowed, how to mend it.

    Commands print it as one message and exit with 2; a library user catches it as a ValueError.
    """

    def __init__(self, what: str, *, where: str = "", allowed: str = "", remedy: str = "") -> None:
        self.what, self.where, self.allowed, self.remedy = what, where, allowed, remedy
        where, what, allowed, remedy = (one_line(part) for part in (where, what, allowed, remedy))
        parts = [f"{where}: {what}" if where else what]
        if allowed:
            parts.append(f"allowed: {allowed}")
        if remedy:
            parts.append(remedy)
        super().__init__("; ".join(parts))


class OutsideError(RuntimeError):
    """Something outside of the program failed that was not the input's fault, such as its worker processes.

    Commands print it as one message and exit with 1.
    """


_LONGEST = 600
"""Characters of a part of a message: a name or a value from a file can have any length."""


def one_line(part: str) -> str:
    """On one line, without control characters (a terminal would obey them), its middle left out where it is long."""
    line = "".join(each if each.isprintable() else "\ufffd" for each in " ".join(part.splitlines()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 3 :]}"


def nearest(word: str, words: Iterable[str]) -> str:
    """The word of `words` most like `word` as a question to the user, or "" if none is near."""
    near = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"did you mean '{near[0]}'?" if near else ""

"""Define the two errors that users see: wrong input, which they can correct, and failures outside the program."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Error for wrong input of a user: says what is wrong and where, what is allowed, and how to correct it.

    Commands print it as one message and exit with status 2. In Python it is a ValueError.

    Parameters
    ----------
    what : str
        The problem, with the value that was given.
    where : str
        The file, option or config key.
    allowed : str
        The values that are valid.
    remedy : str
        What the user can do about it.
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
    """Failure that the user's input did not cause, such as worker processes that die.

    Commands print it as one message and exit with status 1.
    """


_LONGEST = 600
"""Maximum length of one part of a message, in characters: names and values from a file can have any length."""


def one_line(part: str) -> str:
    """Return a text on one line without control characters, for use in error messages: a terminal would obey these characters.

    The middle of a long text is left out.
    """
    line = "".join(each if each.isprintable() else "\ufffd" for each in " ".join(part.splitlines()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 3 :]}"


def nearest(word: str, words: Iterable[str]) -> str:
    """Suggest a correction for a misspelt word: "did you mean '...'?" with the most similar of the allowed `words`.

    Returns "" if none is similar.
    """
    near = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"did you mean '{near[0]}'?" if near else ""

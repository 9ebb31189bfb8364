"""Parse the arguments of every command; mistakes become InputErrors that suggest the nearest correct word."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from typing import NoReturn

from scene.common.errors import InputError, nearest

_NEGATIVE_NUMBERS = re.compile(r"^-\.?\d[\d.,eE+-]*$")
"""Matches arguments that are values, not options: a negative number or several separated by commas, as in --position
-3.5,20,1.
"""


class Parser(argparse.ArgumentParser):
    """Argument parser of all commands: it requires complete option names and has an example in its help.

    It raises InputError instead of exiting.
    """

    def __init__(self, prog: str, description: str, example: str) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=f"example:\n{example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self._negative_number_matcher = _NEGATIVE_NUMBERS

    def parse(self, words: list[str]) -> argparse.Namespace:
        """Parse the words after the command's name. Of several mistakes, an unknown option is reported before a missing one."""
        flags = [flag for action in self._actions for flag in action.option_strings]
        for word in words:
            flag = word.partition("=")[0]
            if flag.startswith("--") and flag not in flags:
                raise InputError(f"unknown option '{flag}'", where=self.prog, remedy=nearest(flag, flags) or self._see_help)
            if word == "" or (flag.startswith("--") and word == f"{flag}="):
                problem = f"{flag} is empty" if flag else "an argument is empty"
                raise InputError(problem, where=self.prog, remedy="give the argument a value; a shell variable may be empty")
        arguments, unknown = self.parse_known_args(words)
        if unknown:
            is_config = "--config" in flags and unknown[0].endswith((".yaml", ".yml"))
            remedy = f"give the config as --config {unknown[0]}" if is_config else self._see_help
            raise InputError(f"unexpected argument '{unknown[0]}'", where=self.prog, remedy=remedy)
        return arguments

    @property
    def _see_help(self) -> str:
        return f"see {self.prog} --help"

    def error(self, message: str) -> NoReturn:
        """Raise a mistake that argparse found as an InputError, so that it is reported like all others.

        message: argparse's description of the mistake.
        """
        raise InputError(f"the command line is wrong: {message}", where=self.prog, remedy=self._see_help)


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Declare --quiet (no progress) and --json (results as JSON), which every computing command has, on its parser."""
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout; text goes to stderr")


def one_of(*allowed: str) -> Callable[[str], str]:
    """Return a function that converts the text of an argument and accepts only the words `allowed`."""

    def check(text: str) -> str:
        if text in allowed:
            return text
        hint = nearest(text.lower(), allowed) or f"allowed: {', '.join(allowed)}"
        raise argparse.ArgumentTypeError(f"got '{text}'; {hint}")

    check.allowed = allowed  # type: ignore[attr-defined]  # for the shells' completion
    return check


def between(low: float, high: float) -> Callable[[str], float]:
    """Return a function that converts the text of an argument to a number and rejects those outside a range.

    low, high: smallest and largest number that is accepted.
    """

    def check(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not low <= number <= high:
            raise argparse.ArgumentTypeError(f"got '{text}'; allowed: a number from {low:g} to {high:g}")
        return number

    return check


def at_least(smallest: int, *, at_most: int | None = None) -> Callable[[str], int]:
    """Return a function that converts the text of an argument to a whole number and rejects those outside a range.

    smallest, at_most: smallest and largest number that is accepted; at_most None: no limit.
    """
    allowed = f"a whole number from {smallest}" + ("" if at_most is None else f" to {at_most}")

    def check(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = smallest - 1
        if number < smallest or (at_most is not None and number > at_most):
            raise argparse.ArgumentTypeError(f"got '{text[:40]}'; allowed: {allowed}")
        return number

    return check

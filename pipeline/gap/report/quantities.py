"""Parameters as people read them: a value and its standard deviation in a unit that suits them, with no digit too many."""

from __future__ import annotations

import math

_UNITS = {
    "m": (("mm", 1e3, 1e-3), ("m", 1.0, 1e-6)),
    "rad": (("µrad", 1e6, 1e-2), ("mrad", 1e3, 1e-5), ("rad", 1.0, 1e-8)),
    "px": (("px", 1.0, 1e-4),),
    "ppm": (("ppm", 1.0, 1e-2),),
}
"""By the suffix of a key: units, the smallest first, how many go into the key's own, and the finest step that is printed."""
_LARGEST_NUMBER = 1000.0
"""From so many of a unit on the next larger one serves."""
_DIGITS = 5
"""Significant digits of a value without a unit of its own."""


def format_with_std(key: str, value: float, std: float | None = None) -> str:
    """`4.02 ± 0.05 mm`: a parameter, in the unit that the suffix of its key names, and its standard deviation.

    The deviation has one significant digit, two where the first is 1, and the value ends where it does; a deviation below the
    finest step that is printed is `< 0.001 mm`. Without a deviation a value has four significant digits.
    """
    unit, factor, step = _choose_unit(key, value, std)
    value *= factor
    if not std or not math.isfinite(std):
        return _join_unit(f"{float(f'{value:.4g}'):g}", unit)
    std *= factor
    if step is None:
        step = 10.0 ** (_exponent(value) - _DIGITS + 1) if value else 0.0
    if std < step / 2:
        return _join_unit(f"{_round_to_step(value, step)} \N{PLUS-MINUS SIGN} < {_round_to_step(step, step)}", unit)
    leading, exponent = f"{std:.1e}".split("e")
    last = max(10.0 ** (int(exponent) - leading.startswith("1")), step)
    return _join_unit(f"{_round_to_step(value, last)} \N{PLUS-MINUS SIGN} {_round_to_step(std, last)}", unit)


def _choose_unit(key: str, value: float, std: float | None) -> tuple[str, float, float | None]:
    """Name of a unit, how many go into the key's own, and the finest step in it; None: by the value's digits."""
    choice = _UNITS.get(key.rpartition("_")[2])
    if choice is None:
        return "", 1.0, None
    largest = max(abs(value), abs(std or 0.0))
    return next((each for each in choice if largest * each[1] < _LARGEST_NUMBER), choice[-1])


def _round_to_step(value: float, step: float) -> str:
    """A value rounded to a step that is a power of ten."""
    digits = -_exponent(step)
    text = f"{round(value, digits) + 0.0:.{max(digits, 0)}f}"
    return text if len(text.lstrip("-")) < 12 else f"{value:.{_DIGITS}g}"


def _exponent(value: float) -> int:
    """Of the first significant digit."""
    return int(f"{abs(value):e}".partition("e")[2])


def _join_unit(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text

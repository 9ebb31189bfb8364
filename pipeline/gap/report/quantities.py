"""Format parameters for readers: value and standard deviation in a suitable unit, without insignificant digits."""

from __future__ import annotations

import math

_UNITS = {
    "m": (("mm", 1e3, 1e-3), ("m", 1.0, 1e-6)),
    "rad": (("µrad", 1e6, 1e-2), ("mrad", 1e3, 1e-5), ("rad", 1.0, 1e-8)),
    "px": (("px", 1.0, 1e-4),),
    "ppm": (("ppm", 1.0, 1e-2),),
}
"""By the suffix of a key: units from the smallest, their number in one of the key's unit, and the smallest step that is
printed."""
_LARGEST_NUMBER = 1000.0
"""From this number on the next larger unit is used."""
_DIGITS = 5
"""Significant digits of a value without a unit of its own."""


def format_with_std(key: str, value: float, std: float | None = None) -> str:
    """Format a parameter of a sensor error with its standard deviation for the report, such as `4.02 ± 0.05 mm`.

    The standard deviation has one significant digit, two if the first is 1, and the value ends at the same digit. A standard
    deviation below the smallest step that is printed becomes `< 0.001 mm`. Without one, the value has four significant digits.

    Parameters
    ----------
    key : key of the parameter, whose suffix names its unit, such as `amplitude_m`.
    value : value in that unit.
    std : standard deviation in that unit; None if it is not known.
    """
    unit, factor, step = _choose_unit(key, value, std)
    value *= factor
    if not std or not math.isfinite(std):
        return f"{float(f'{value:.4g}'):g} {unit}".rstrip()
    std *= factor
    if step is None:
        step = 10.0 ** (_exponent(value) - _DIGITS + 1) if value else 0.0
    if std < step / 2:
        return f"{_round_to_step(value, step)} \N{PLUS-MINUS SIGN} < {_round_to_step(step, step)} {unit}".rstrip()
    leading, exponent = f"{std:.1e}".split("e")
    last = max(10.0 ** (int(exponent) - leading.startswith("1")), step)
    return f"{_round_to_step(value, last)} \N{PLUS-MINUS SIGN} {_round_to_step(std, last)} {unit}".rstrip()


def _choose_unit(key: str, value: float, std: float | None) -> tuple[str, float, float | None]:
    """Choose the unit in which a value is written.

    Returns the unit's name, its number in one of the key's unit, and the smallest step to write in it. The step is None if the
    value's own digits decide.
    """
    choice = _UNITS.get(key.rpartition("_")[2])
    if choice is None:
        return "", 1.0, None
    largest = max(abs(value), abs(std or 0.0))
    return next((each for each in choice if largest * each[1] < _LARGEST_NUMBER), choice[-1])


def _round_to_step(value: float, step: float) -> str:
    """Format a value rounded to a step that is a power of ten."""
    digits = -_exponent(step)
    text = f"{round(value, digits) + 0.0:.{max(digits, 0)}f}"
    return text if len(text.lstrip("-")) < 12 else f"{value:.{_DIGITS}g}"


def _exponent(value: float) -> int:
    """Decimal exponent of the first significant digit."""
    return int(f"{abs(value):e}".partition("e")[2])

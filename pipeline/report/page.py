"""Provide templates, embedded pictures and formatted numbers for all reports. The pages need no network and can be printed."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import jinja2

_HERE = Path(__file__).parent
_NOTHING = "\N{EN DASH}"
_LEAST_P = 0.001


@cache
def template(name: str) -> jinja2.Template:
    """Load a Jinja2 template of an HTML report, with the filters that format numbers and embed pictures in all reports.

    Parameters
    ----------
    name : str
        Path of the template, relative to the folder `pipeline` or `pipeline/report`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([_HERE, _HERE.parent]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "mm": millimetres,
        "numbers": _numbers,
        "litres": litres,
        "percent": percent,
        "picture": picture_source,
    }
    return environment.get_template(name)


def p_value_in_words(p: float | None) -> str:
    """Format a p-value for a report: two digits, or "< 0.001"; a dash for None.

    Smaller values are not distinguished, because with many pixels their powers of ten mean nothing.
    """
    if p is None:
        return _NOTHING
    return f"{p:.2g}" if p >= _LEAST_P else f"< {_LEAST_P:g}"


def millimetres(metres: float | None, digits: int = 1) -> str:
    """Format a length in metres as text in millimetres, with `digits` decimals; a dash for None or NaN."""
    return _NOTHING if metres is None or math.isnan(metres) else f"{with_minus_sign(metres * 1e3, digits)} mm"


def percent(ratio: float | None, digits: int = 1, *, signed: bool = False) -> str:
    """Format a ratio for a report as text in per cent; a dash for None or NaN.

    Parameters
    ----------
    ratio : float or None
        The ratio; 1 is 100 %.
    digits : int
        Number of decimals.
    signed : bool
        Whether a number that is not negative gets a plus sign.
    """
    if ratio is None or math.isnan(ratio):
        return _NOTHING
    plus = "+" if signed and ratio >= 0 else ""
    return f"{plus}{with_minus_sign(100 * ratio, digits)} %"


def with_minus_sign(value: float, digits: int) -> str:
    """Format a number with `digits` decimals for a report, with a typographic minus sign. A rounded zero has no sign."""
    return f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}" if round(value, digits) else "")


def picture_source(png: bytes) -> str:
    """Encode a PNG as a data URL for the attribute `src` of an HTML image, so that a report is one file."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _numbers(values: Sequence[float], digits: int = 2, factor: float = 1.0) -> str:
    """Format several numbers."""
    return ", ".join(with_minus_sign(factor * value, digits) for value in values)


def litres(cubic_metres: float | None) -> str:
    """Format a volume in cubic metres as a number in litres with three significant digits, without unit; a dash for None."""
    if cubic_metres is None:
        return _NOTHING
    value = 1e3 * cubic_metres
    digits = max(2 - math.floor(math.log10(abs(value))), 0) if value else 2
    return f"{value:,.{digits}f}".replace("-", "\N{MINUS SIGN}" if round(value, digits) else "")

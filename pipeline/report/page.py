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
    """Return a template by its path in `pipeline`, with the filters that reports share. It includes style.css."""
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
    """Format a p-value to the precision that is meaningful: with many pixels, tests give powers of ten that are not."""
    if p is None:
        return _NOTHING
    return f"{p:.2g}" if p >= _LEAST_P else f"< {_LEAST_P:g}"


def millimetres(metres: float | None, digits: int = 1) -> str:
    """Format metres as millimetres; a dash if there is no value."""
    return _NOTHING if metres is None or math.isnan(metres) else f"{with_minus_sign(metres * 1e3, digits)} mm"


def percent(ratio: float | None, digits: int = 1, *, signed: bool = False) -> str:
    """Format a share as per cent; a dash if there is no value."""
    if ratio is None or math.isnan(ratio):
        return _NOTHING
    plus = "+" if signed and ratio >= 0 else ""
    return f"{plus}{with_minus_sign(100 * ratio, digits)} %"


def with_minus_sign(value: float, digits: int) -> str:
    """Format a number with a true minus sign, and none for zero."""
    return f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}" if round(value, digits) else "")


def picture_source(png: bytes) -> str:
    """Return a PNG as the `src` of an embedded picture."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _numbers(values: Sequence[float], digits: int = 2, factor: float = 1.0) -> str:
    """Format several numbers."""
    return ", ".join(with_minus_sign(factor * value, digits) for value in values)


def litres(cubic_metres: float | None) -> str:
    """Format cubic metres as litres with three significant digits, which suits a pebble as well as a house."""
    if cubic_metres is None:
        return _NOTHING
    value = 1e3 * cubic_metres
    digits = max(2 - math.floor(math.log10(abs(value))), 0) if value else 2
    return f"{value:,.{digits}f}".replace("-", "\N{MINUS SIGN}" if round(value, digits) else "")

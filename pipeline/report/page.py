"""What all reports share: their templates, pictures inside the page, numbers in words. A page needs no network and prints."""

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
    """A template by its path in `pipeline`, with the filters that reports share; it includes style.css for their look."""
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
    """A p-value as far as it means something: tests of many pixels give powers of ten that do not."""
    if p is None:
        return _NOTHING
    return f"{p:.2g}" if p >= _LEAST_P else f"< {_LEAST_P:g}"


def millimetres(metres: float | None, digits: int = 1) -> str:
    """Metres as millimetres; a dash where there is no value."""
    return _NOTHING if metres is None or math.isnan(metres) else f"{true_minus(metres * 1e3, digits)} mm"


def percent(ratio: float | None, digits: int = 1, *, signed: bool = False) -> str:
    """A share as per cent; a dash where there is no value."""
    if ratio is None or math.isnan(ratio):
        return _NOTHING
    plus = "+" if signed and ratio >= 0 else ""
    return f"{plus}{true_minus(100 * ratio, digits)} %"


def true_minus(value: float, digits: int) -> str:
    """A number with a minus sign that is as wide as a plus, and none on a zero."""
    return f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}" if round(value, digits) else "")


def picture_source(png: bytes) -> str:
    """A PNG as the `src` of a picture that stands inside the page."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _numbers(values: Sequence[float], digits: int = 2, factor: float = 1.0) -> str:
    return ", ".join(true_minus(factor * value, digits) for value in values)


def litres(cubic_metres: float | None) -> str:
    """Cubic metres as litres, to three significant digits, so that a pebble and a house both show."""
    if cubic_metres is None:
        return _NOTHING
    value = 1e3 * cubic_metres
    digits = max(2 - math.floor(math.log10(abs(value))), 0) if value else 2
    return f"{value:,.{digits}f}".replace("-", "\N{MINUS SIGN}" if round(value, digits) else "")

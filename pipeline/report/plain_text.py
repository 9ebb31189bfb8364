"""Draw text in pictures literally: a $ in the name of a sensor or a file is not a formula."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, NullFormatter

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@contextmanager
def plain_text(figure: Figure) -> Iterator[None]:
    """Show all text of a figure literally while it is drawn inside the `with` block: a $ in a name does not begin a formula.

    Characters that cannot be printed or that the font lacks become boxes. Matplotlib writes the labels of a logarithmic axis as
    formulas, so such an axis needs `powers_of_ten`.
    """
    with rc_context({"text.parse_math": False}), warnings.catch_warnings():  # for tick labels, which are made while drawing
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        for text in _texts(figure):
            text.set_parse_math(False)
            text.set_text("".join(each if each.isprintable() or each == "\n" else "\ufffd" for each in text.get_text()))
        yield


def _texts(artist: Artist) -> Iterator[Text]:
    """Find the texts in an element of a figure (an artist, in Matplotlib's words) and in all elements that it contains.

    Matplotlib's `findobj` would first make the ticks of each axis, which takes a third of the time of a picture.
    """
    if isinstance(artist, Text):
        yield artist
    made = vars(artist)
    ticks = [*made.get("majorTicks", ()), *made.get("minorTicks", ())]
    for child in [artist.label, artist.offsetText, *ticks] if isinstance(artist, Axis) else artist.get_children():
        yield from _texts(child)


def powers_of_ten(axis: Axis) -> None:
    """Label the ticks of a logarithmic (or symlog) axis as 10⁻² ... 10³ in plain text, and values between powers as numbers."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: power_of_ten(value)))
    axis.set_minor_formatter(NullFormatter())


def power_of_ten(value: float) -> str:
    """Format a power of ten in plain text, such as 10⁻²; other values as ordinary numbers."""
    mantissa, exponent = f"{value:.6e}".split("e")
    return f"10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if float(mantissa) == 1 else f"{value:g}"

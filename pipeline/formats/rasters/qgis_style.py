"""Write QGIS styles (.qml): with such a file beside it, a raster opens in the colours of the reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from pipeline.formats.files.atomic import write_text

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_NO_DATA = "181,181,181,255"


@dataclass(frozen=True)
class Stop:
    """A fixed point of a raster's colour scale: a value, its colour (#rrggbb) and its label in the legend."""

    value: float
    colour: str
    label: str


def write_style(raster: Path, stops: Sequence[Stop]) -> None:
    """Write a style file beside a one-band raster, with which QGIS colours it when it opens the raster.

    raster: path of the raster. stops: fixed points of the colour scale, in rising order. Colours are interpolated between them;
    values beyond them have the last colour.
    """
    low, high = (f"{stops[place].value:.9g}" for place in (0, -1))
    root = ElementTree.Element("qgis", {"version": "3.28.0", "styleCategories": "Symbology"})
    renderer = ElementTree.SubElement(
        ElementTree.SubElement(root, "pipe"),
        "rasterrenderer",
        {"type": "singlebandpseudocolor", "band": "1", "opacity": "1", "alphaBand": "-1", "nodataColor": _NO_DATA,
         "classificationMin": low, "classificationMax": high},
    )  # fmt: skip
    shader = ElementTree.SubElement(
        ElementTree.SubElement(renderer, "rastershader"),
        "colorrampshader",
        {"colorRampType": "INTERPOLATED", "classificationMode": "1", "clip": "0", "minimumValue": low, "maximumValue": high},
    )
    for stop in stops:
        values = {"value": f"{stop.value:.9g}", "color": stop.colour, "label": stop.label, "alpha": "255"}
        ElementTree.SubElement(shader, "item", values)
    ElementTree.indent(root)
    write_text(raster.with_suffix(".qml"), _DOCTYPE + ElementTree.tostring(root, encoding="unicode") + "\n")

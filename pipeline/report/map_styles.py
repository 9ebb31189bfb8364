"""Write the colours of the reports as QGIS styles beside the maps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from pipeline.formats.rasters.qgis_style import Stop, write_style
from pipeline.report.figures import COLOURS, SEQUENTIAL

_STEPS = 12
"""Number of colour steps."""


def difference_style(raster: Path, limit_m: float) -> None:
    """Write a QGIS style file (.qml) beside a map of changes, so that QGIS opens it in the colours of the reports.

    Red is where rock is missing. The legend is in mm.

    Parameters
    ----------
    raster : Path
        File of the map, whose values are reference minus epoch, m.
    limit_m : float
        The colours reach from -limit_m to +limit_m, m.
    """
    _write(raster, COLOURS, -limit_m, limit_m, lambda value: f"{1e3 * value:+.3g} mm")


def quantity_style(raster: Path, values: NDArray[np.floating], unit: str, factor: float = 1.0) -> None:
    """Write a QGIS style file (.qml) beside a map of any quantity, so that QGIS opens it in the colours of the reports.

    The colours span the 1 to 99 % quantiles of the values.

    Parameters
    ----------
    raster : Path
        File of the map.
    values : array
        Values in the file, of any shape; NaN without data.
    unit : str
        Unit that the legend shows.
    factor : float
        Factor by which `values` are multiplied for the legend, to get `unit`.
    """
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, [0.01, 0.99]).tolist() if known.size else (0.0, 1.0)
    high = high if high > low else low + max(abs(low), 1.0) * 1e-3
    _write(raster, SEQUENTIAL, low, high, lambda value: f"{factor * value:.4g} {unit}".strip())


def _write(raster: Path, colours: Any, low: float, high: float, label: Callable[[float], str]) -> None:
    """Write a style with evenly spaced colours."""
    places = np.linspace(0.0, 1.0, _STEPS + 1).tolist()
    values = [low + place * (high - low) for place in places]
    write_style(raster, [Stop(value, to_hex(colours(place)), label(value)) for place, value in zip(places, values, strict=True)])

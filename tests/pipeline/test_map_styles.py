"""QGIS styles beside the maps: well-formed, with the reports' colours at the raster's values."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pipeline.report.map_styles import difference_style, quantity_style


def items(path: Path) -> list[tuple[float, str, str]]:
    """Return value, colour and label of a style's colour stops."""
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE qgis")
    renderer = ElementTree.fromstring(text).find("pipe/rasterrenderer")
    assert renderer is not None
    assert (renderer.get("type"), renderer.get("band")) == ("singlebandpseudocolor", "1")
    found = [(float(each.get("value", "")), each.get("color", ""), each.get("label", "")) for each in renderer.iter("item")]
    assert [float(renderer.get(f"classification{end}", "")) for end in ("Min", "Max")] == [found[0][0], found[-1][0]]
    return found


def test_missing_rock_is_red_and_the_legend_in_millimetres(tmp_path: Path) -> None:
    difference_style(tmp_path / "difference_001.tif", 0.03)
    stops = items(tmp_path / "difference_001.qml")
    values = [value for value, _, _ in stops]
    assert values == sorted(values)
    assert (values[0], values[-1]) == (-0.03, 0.03)
    (low, high), middle = (stops[place][1] for place in (0, -1)), stops[len(stops) // 2]
    assert int(high[1:3], 16) > int(high[5:7], 16) + 50  # red
    assert int(low[5:7], 16) > int(low[1:3], 16) + 50  # blue
    assert abs(middle[0]) < 1e-9
    assert min(int(middle[1][at : at + 2], 16) for at in (1, 3, 5)) > 230
    assert stops[-1][2] == "+30 mm"


def test_other_maps_span_their_values(tmp_path: Path) -> None:
    values = np.linspace(0.0, 0.1, 1001)
    values[3] = np.nan
    quantity_style(tmp_path / "lod.tif", values, "mm", 1e3)
    stops = items(tmp_path / "lod.qml")
    assert abs(stops[0][0] - 0.001) < 2e-4
    assert abs(stops[-1][0] - 0.099) < 2e-4
    assert stops[-1][2].endswith(" mm")
    quantity_style(tmp_path / "views.tif", np.ones(9), "")
    assert items(tmp_path / "views.qml")[0][2] == "1"
    quantity_style(tmp_path / "none.tif", np.full(9, np.nan), "m")
    assert len(items(tmp_path / "none.qml")) > 2

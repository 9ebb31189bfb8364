"""Make the two pictures of the page with Plotly: the wall in 3D and the same window as a map."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.colors import diverging, sequential

from pipeline.view.results import Item, Layer, Patch, PointLayer, ViewWindow

ITEM_TRACES = ("block", "detection", "event", "scene change")
"""Kinds of items, in drawing order."""
_COLOURS = {"block": "#000000", "detection": "#D55E00", "event": "#000000", "scene change": "#009E73"}
"""Black, and colours of Okabe and Ito that differ from red, blue and grey also for colour-blind readers."""
_DASHES = {"block": "solid", "detection": "dash", "event": "solid", "scene change": "dot"}
_SELECTED = "#E69F00"
_GREYS = [[0.0, "#202020"], [1.0, "#f4f4f4"]]
_PLAIN = "#9aa0a6"
_NO_DATA = "#c9ccd0"
_EDGES = ((0, 2, 4), (1, 2, 4), (1, 3, 4), (0, 3, 4), (0, 2, 4), (0, 2, 5), (1, 2, 5), (1, 3, 5), (0, 3, 5), (0, 2, 5))
_POSTS = ((1, 2), (1, 3), (0, 3))
"""Edges of a box: one line around bottom and top, and the other three upright edges; indices into (x0, x1, y0, y1, z0, z1)."""
_FLAT = {"ambient": 0.75, "diffuse": 0.45, "specular": 0.02, "roughness": 0.9, "fresnel": 0.05}
"""Plotly's lighting of the surface."""
_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])
"""Direction towards the light of the shaded map."""
_FROM = np.array([-0.16, -0.1, 1.0])
"""Direction of the camera: from the front, slightly from the left and from below."""
_FIELD_OF_VIEW, _WIDE, _MARGIN = np.radians(45.0), 1.5, 1.15
"""Plotly's vertical field of view; smallest ratio of width to height of the picture on a desktop; margin around the wall."""
_FACTS_SHOWN = 6
_MARKER_PX, _FEW = 4.5, 80


def wall_figure(
    patch: Patch,
    points: PointLayer | None,
    items: Sequence[Item],
    layer: Layer,
    shown: Collection[str],
    selected: int | None = None,
) -> go.Figure:
    """Draw the wall in 3D with Plotly, for the page of `scarpsim view`.

    Parameters
    ----------
    patch : Patch
        Heights and values of the surface in the part of the wall that is shown.
    points : PointLayer or None
        The measured points in this part; None: there are none.
    items : sequence of Item
        Blocks, detections, events or changes, drawn as boxes.
    layer : Layer
        The quantity that gives the colours.
    shown : collection of str
        What to draw: any of "surface", "points", "block", "detection", "event" and "scene change".
    selected : int, optional
        Index in `items` of the one to highlight.
    """
    figure = go.Figure()
    if "surface" in shown:
        figure.add_trace(_surface(patch, layer))
    if points is not None and "points" in shown:
        figure.add_trace(_cloud(points, layer, coloured_alone="surface" not in shown))
    for kind in ITEM_TRACES:
        chosen = [(number, item) for number, item in enumerate(items) if item.kind == kind and _overlaps(item, patch)]
        if kind in shown and chosen:
            boxes = [_with_depth(item, patch) for _, item in chosen]
            figure.add_trace(_wires(boxes, _COLOURS[kind], 3, dash=_DASHES[kind]))
            figure.add_trace(_handles(chosen, boxes, kind))
    if selected is not None and selected < len(items) and _overlaps(items[selected], patch):
        figure.add_trace(_wires([_with_depth(items[selected], patch)], _SELECTED, 8))
    axis: dict[str, Any] = {"showbackground": False, "gridcolor": "#dfe3e6", "zeroline": False, "showspikes": False}
    figure.update_layout(
        scene={
            "aspectmode": "data",
            "uirevision": "camera",
            "xaxis": {**axis, "title": "along the wall, m"},
            "yaxis": {**axis, "title": "up the wall, m"},
            "zaxis": {**axis, "title": "towards the sensor, m"},
            "camera": {"up": {"x": 0, "y": 1, "z": 0}, "eye": _eye(patch)},
        },
        uirevision="camera",
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        showlegend=False,
    )
    return figure


def _eye(patch: Patch) -> dict[str, float]:
    """Return the position of the camera that shows the whole patch; 1 is the geometric mean of the patch's extents."""
    heights = patch.height[np.isfinite(patch.height)]
    extent = np.array([np.ptp(patch.x), np.ptp(patch.y), np.ptp(heights) if heights.size else 0.0])
    extent = np.maximum(extent, 1e-3 * extent.max())
    width, height, depth = extent / np.cbrt(extent.prod())
    distance = _MARGIN * max(height, width / _WIDE) / (2 * np.tan(_FIELD_OF_VIEW / 2)) + depth / 2
    return {axis: float(distance * part) for axis, part in zip("xyz", _FROM, strict=True)}


def map_figure(
    patch: Patch,
    items: Sequence[Item],
    layer: Layer,
    shown: Collection[str],
    window: ViewWindow | None,
    selected: int | None = None,
) -> go.Figure:
    """Draw a part of the wall as a map with Plotly, with outlines of its blocks or events, for the page of `scarpsim view`.

    Parameters
    ----------
    patch : Patch
        Values of the map in the part of the wall that is shown.
    items : sequence of Item
        All blocks, detections, events or changes; those that overlap the patch are drawn.
    layer : Layer
        The quantity that gives the colours.
    shown : collection of str
        Which items to draw: any of "block", "detection", "event" and "scene change".
    window : ViewWindow or None
        Limits of the axes, wall frame, m; None for the whole patch.
    selected : int, optional
        Index in `items` of the one to highlight.
    """
    figure = go.Figure(_heatmap(patch, layer))
    for kind in ITEM_TRACES:
        chosen = [(number, item) for number, item in enumerate(items) if item.kind == kind and _overlaps(item, patch)]
        if kind in shown and chosen:
            outlines = _outlines([item for _, item in chosen])
            line = {"color": _COLOURS[kind], "width": 1, "dash": _DASHES[kind]}
            figure.add_trace(go.Scatter(x=outlines[0], y=outlines[1], mode="lines", line=line, hoverinfo="skip", name=kind))
            figure.add_trace(_map_handles(chosen, kind))
    if selected is not None and selected < len(items):
        x, y = _outlines([items[selected]])
        figure.add_trace(go.Scatter(x=x, y=y, mode="lines", line={"color": _SELECTED, "width": 4}, hoverinfo="skip"))
    left, right, low, high = window or _extent(patch)
    plain = {"constrain": "domain", "showgrid": False, "zeroline": False}
    figure.update_layout(
        xaxis={**plain, "range": [left, right], "title": "along the wall, m"},
        yaxis={**plain, "range": [low, high], "scaleanchor": "x", "title": "up the wall, m"},
        margin={"l": 55, "r": 5, "t": 5, "b": 45},
        plot_bgcolor=_NO_DATA,
        showlegend=False,
        dragmode="zoom",
        uirevision=str(window),
    )
    return figure


def _surface(patch: Patch, layer: Layer) -> go.Surface:
    """Make the trace of the surface."""
    colour = hillshade(patch) if layer.key == "rock" else patch.value
    return go.Surface(
        x=patch.x,
        y=patch.y,
        z=patch.height.astype(np.float32),
        surfacecolor=colour.astype(np.float32),
        **_hover_data(patch),
        hovertemplate="x %{x:.2f} m, y %{y:.2f} m, z %{z:.3f} m" + _hover_value(layer),
        lighting=_FLAT,
        lightposition={"x": -1000, "y": 1000, "z": 2000},
        contours={axis: {"highlight": False} for axis in "xyz"},
        **_scale(colour, layer),
    )


def _heatmap(patch: Patch, layer: Layer) -> go.Heatmap:
    """Make the trace of the map."""
    colour = hillshade(patch) if layer.key == "rock" else patch.value
    scale = _scale(colour, layer)
    limits = {"zmin": scale.pop("cmin"), "zmax": scale.pop("cmax")}
    return go.Heatmap(
        x=patch.x,
        y=patch.y,
        z=colour.astype(np.float32),
        **_hover_data(patch),
        hovertemplate="x %{x:.2f} m, y %{y:.2f} m" + _hover_value(layer),
        **{**scale, "showscale": False},
        **limits,
    )


def _hover_data(patch: Patch) -> dict[str, Any]:
    """Return value and block of each cell, for the hover label."""
    names = {0: ""} | {int(number): f"<br>block {number}" for number in np.unique(patch.label) if number}
    return {
        "customdata": patch.value.astype(np.float32),
        "text": [[names[number] for number in row] for row in patch.label.tolist()],
    }


def _hover_value(layer: Layer) -> str:
    """Return the hover label's template for a layer."""
    digits = 1 if layer.unit == "mm" else 3
    value = "" if layer.key == "rock" else f"<br><b>{layer.label}: %{{customdata:.{digits}f}} {layer.unit}</b>"
    return f"{value}%{{text}}<extra></extra>"


def _scale(colour: NDArray[np.floating], layer: Layer) -> dict[str, Any]:
    """Return the colour scale with its limits and title."""
    if layer.key == "rock":
        return {"colorscale": _GREYS, "cmin": -0.1, "cmax": 1.0, "showscale": False}
    if layer.diverging and layer.limit is not None:
        low, high, colours = -layer.limit, layer.limit, list(reversed(diverging.RdBu))
    else:
        known = colour[np.isfinite(colour)]
        low, high = np.quantile(known, [0.01, 0.99]) if known.size else (0.0, 1.0)
        colours = sequential.Viridis
    bar = {"title": {"text": f"{layer.label}, {layer.unit}", "side": "right"}, "thickness": 14, "len": 0.7}
    return {"colorscale": colours, "cmin": float(low), "cmax": float(high), "colorbar": bar}


def hillshade(patch: Patch) -> NDArray[np.floating]:
    """Compute a shaded relief of a part of the wall, lit from the upper left, like the hillshades of the reports.

    Returns the brightness of each cell of the patch, (h, w), at most 1.
    """
    if min(patch.height.shape) < 2:
        return np.ones_like(patch.height)
    down, right = np.gradient(patch.height, -patch.y, patch.x)
    slope = np.sqrt(1 + right**2 + down**2)
    return np.asarray((-_LIGHT[0] * right + _LIGHT[1] * down + _LIGHT[2]) / slope)


def _cloud(points: PointLayer, layer: Layer, *, coloured_alone: bool) -> go.Scatter3d:
    """Make the trace of the measured points, with their properties in the hover labels."""
    facts = {name.replace("_", " "): channel for name, channel in list(points.facts.items())[:_FACTS_SHOWN]}
    if points.value is not None:
        facts = {f"{layer.label}, {layer.unit}": np.round(points.value, 2), **facts}
    known = np.array([channel.astype(object) for channel in facts.values()]).T if facts else None
    lines = [f"<br>{name}: %{{customdata[{number}]}}" for number, name in enumerate(facts)]
    marker: dict[str, Any] = {"size": 2, "color": _PLAIN}
    if points.value is not None:
        scale = _scale(points.value, layer)
        marker |= {"color": points.value.astype(np.float32), **scale, "showscale": coloured_alone}
        marker["colorbar"] = scale["colorbar"]
    x, y, z = points.points.T
    return go.Scatter3d(
        x=x.astype(np.float32),
        y=y.astype(np.float32),
        z=z.astype(np.float32),
        mode="markers",
        marker=marker,
        customdata=known,
        hovertemplate="measured point<br>x %{x:.3f} m, y %{y:.3f} m, z %{z:.3f} m" + "".join(lines) + "<extra></extra>",
    )


def _overlaps(item: Item, patch: Patch) -> bool:
    """Return whether an item overlaps the patch."""
    x0, x1, y0, y1 = item.box[:4]
    left, right, low, high = _extent(patch)
    return x1 >= left and x0 <= right and y1 >= low and y0 <= high


def _with_depth(item: Item, patch: Patch) -> tuple[float, ...]:
    """Return the item's box, with the range of the surface's heights there if it has none of its own."""
    x0, x1, y0, y1, z0, _ = item.box
    if np.isfinite(z0):
        return item.box
    columns, rows = (patch.x >= x0) & (patch.x <= x1), (patch.y >= y0) & (patch.y <= y1)
    near = patch.height[np.ix_(rows, columns)]
    known = near[np.isfinite(near)]
    whole = patch.height[np.isfinite(patch.height)]
    known = known if known.size else (np.array([np.median(whole)]) if whole.size else np.zeros(1))
    return x0, x1, y0, y1, float(known.min()), float(known.max())


def _wires(boxes: Sequence[Sequence[float]], colour: str, width: int, dash: str = "solid") -> go.Scatter3d:
    """Make one trace of the edges of boxes."""
    x: list[float | None] = []
    y: list[float | None] = []
    z: list[float | None] = []
    for box in boxes:
        strokes = [[(box[i], box[j], box[k]) for i, j, k in _EDGES]]
        strokes += [[(box[i], box[j], box[4]), (box[i], box[j], box[5])] for i, j in _POSTS]
        for stroke in strokes:
            for into, values in zip((x, y, z), zip(*stroke, strict=True), strict=True):
                into.extend([*values, None])
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line={"color": colour, "width": width, "dash": dash}, hoverinfo="skip")


def _handles(chosen: Sequence[tuple[int, Item]], boxes: Sequence[Sequence[float]], kind: str) -> go.Scatter3d:
    """Make markers in front of the items to point at and click on; the custom datum is the item's number."""
    return go.Scatter3d(
        x=[(box[0] + box[1]) / 2 for box in boxes],
        y=[(box[2] + box[3]) / 2 for box in boxes],
        z=[box[5] for box in boxes],
        mode="markers",
        marker=_marker(kind, len(chosen)),
        **_labels(chosen),
    )


def _map_handles(chosen: Sequence[tuple[int, Item]], kind: str) -> go.Scatter:
    """Make the markers of the map."""
    return go.Scatter(
        x=[(item.box[0] + item.box[1]) / 2 for _, item in chosen],
        y=[(item.box[2] + item.box[3]) / 2 for _, item in chosen],
        mode="markers",
        marker=_marker(kind, len(chosen)),
        name=kind,
        **_labels(chosen),
    )


def _marker(kind: str, count: int) -> dict[str, Any]:
    """Return the style of markers. The more there are, the smaller they are, so that the wall remains visible."""
    size = float(np.clip(_MARKER_PX * np.sqrt(_FEW / count), 2.0, _MARKER_PX))
    return {"size": size, "color": _COLOURS[kind], "line": {"width": 0}}


def _labels(chosen: Sequence[tuple[int, Item]]) -> dict[str, Any]:
    """Return the hover labels of items."""
    text = [
        "<br>".join([f"<b>{item.name}</b>", *(f"{name}: {value}" for name, value in item.facts.items())]) for _, item in chosen
    ]
    return {"customdata": [[number] for number, _ in chosen], "text": text, "hovertemplate": "%{text}<extra></extra>"}


def _outlines(items: Sequence[Item]) -> tuple[list[float | None], list[float | None]]:
    """Return the outlines of items as one line."""
    x: list[float | None] = []
    y: list[float | None] = []
    for item in items:
        x0, x1, y0, y1 = item.box[:4]
        x += [x0, x1, x1, x0, x0, None]
        y += [y0, y0, y1, y1, y0, None]
    return x, y


def _extent(patch: Patch) -> ViewWindow:
    """Return the window that a patch covers."""
    return ViewWindow(float(patch.x.min()), float(patch.x.max()), float(patch.y.min()), float(patch.y.max()))

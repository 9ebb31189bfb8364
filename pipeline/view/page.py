"""Define the page's parts and what happens when they are used."""

from __future__ import annotations

from threading import Lock
from typing import Any

import dash
from dash import Input, Output, State, ctx, dcc, html, no_update

from pipeline.view.figures import ITEM_TRACES, map_figure, wall_figure
from pipeline.view.results import Item, Layer, Results, ViewWindow
from pipeline.view.split_view import OTHER, Pair, border, split_patch

CELLS, POINTS = 60_000, 40_000
"""Limits on what a window shows, so that it rotates smoothly on a laptop without a graphics card."""
_NOTHING = ""
"""The choice to show nothing beside."""
_PLAY, _STOP, _EPOCH_MS = "play", "stop", 2500
_GRAPH: Any = {
    "displaylogo": False,
    "scrollZoom": True,
    "showSendToCloud": False,
    "modeBarButtonsToRemove": ["select2d", "lasso2d"],
}


def layout(results: Results, other: Results | None = None) -> html.Main:
    """Make the page of `scarpsim view`: controls on the left, the wall in 3D, the map, and the properties of the selected item.

    results: what is shown. other: a second run of the same wall, to be shown beside it.
    """
    first, surface = next(iter(results.steps)), next(iter(results.surfaces))
    shown = ["surface", *ITEM_TRACES]
    controls = [
        _control(results.step_name, dcc.Dropdown(_options(results.steps), first, id="step", clearable=False)),
        _control("colour", dcc.Dropdown([], None, id="layer", clearable=False)),
        _control("surface", dcc.Dropdown(_options(results.surfaces), surface, id="surface", clearable=False)),
        _control("show", dcc.Checklist(["surface", "points", *_kinds(results)], shown, id="shown")),
        _control(
            "beside it, right of the border",
            dcc.Dropdown(
                _options({_NOTHING: "nothing"} | Pair(results, other).choices), _first_beside(other), id="beside", clearable=False
            ),
        ),
        dcc.Slider(0, 100, value=50, marks=None, id="border", updatemode="mouseup"),
        _control("look at", dcc.Dropdown([], None, id="item", placeholder="block, detection, ...")),
        html.Div([html.Button("previous", id="previous"), html.Button("next", id="next"), html.Button("whole wall", id="whole")]),
        html.Div(
            [
                html.Button(_PLAY, id="play", disabled=len(results.steps) < 2),
                dcc.Interval(id="clock", interval=_EPOCH_MS, disabled=True),
            ]
        ),
        html.Div(id="facts"),
        html.P(id="note", className="note"),
    ]
    return html.Main(
        [
            html.H1(results.title),
            html.Div(
                [
                    html.Div(controls, className="controls"),
                    html.Div(
                        [
                            dcc.Graph(id="wall", config=_GRAPH, className="wall", responsive=True),
                            dcc.Graph(id="map", config=_GRAPH, className="map", responsive=True),
                        ],
                        className="pictures",
                    ),
                ],
                className="columns",
            ),
            dcc.Store(id="window"),
        ]
    )


def register_callbacks(app: dash.Dash, results: Results, lock: Lock, other: Results | None = None) -> None:
    """Connect the parts of the page of `scarpsim view`, so that a choice in one redraws the others.

    Parameters
    ----------
    app : dash.Dash
        The page.
    results : Results
        What is shown.
    lock : Lock
        Lets only one request at a time compute.
    other : Results, optional
        A second run of the same wall, to be shown beside it.
    """

    @app.callback(Output("layer", "options"), Output("layer", "value"), Input("step", "value"), State("layer", "value"))
    def offer_layers(step: str, chosen: str | None) -> tuple[list[dict[str, str]], str]:
        keys = {layer.key: layer.label for layer in results.layers(step)}
        return _options(keys), chosen if chosen in keys else next(iter(keys))

    @app.callback(
        Output("clock", "disabled"), Output("play", "children"), Input("play", "n_clicks"), State("clock", "disabled"),
        prevent_initial_call=True,
    )  # fmt: skip
    def play(_clicks: Any, stopped: bool) -> tuple[bool, str]:
        return not stopped, _STOP if stopped else _PLAY

    @app.callback(
        Output("step", "value"), Input("clock", "n_intervals"), State("step", "value"), prevent_initial_call=True
    )  # fmt: skip
    def turn(_count: Any, step: str) -> str:
        return following(list(results.steps), step)

    @app.callback(Output("item", "options"), Input("step", "value"))
    def offer_items(step: str) -> list[dict[str, Any]]:
        with lock:
            return [{"label": item.name, "value": number} for number, item in enumerate(results.items(step))]

    @app.callback(
        Output("item", "value"),
        Input("previous", "n_clicks"),
        Input("next", "n_clicks"),
        Input("wall", "clickData"),
        Input("map", "clickData"),
        Input("step", "value"),
        State("item", "value"),
        State("item", "options"),
        prevent_initial_call=True,
    )
    def choose(_back: Any, _on: Any, wall: Any, flat: Any, _step: str, now: int | None, options: list[Any]) -> Any:
        if ctx.triggered_id == "step" or not options:
            return None
        if ctx.triggered_id in ("wall", "map"):
            number = clicked(wall if ctx.triggered_id == "wall" else flat)
            return no_update if number is None else number
        move = 1 if ctx.triggered_id == "next" else -1
        return (now + move) % len(options) if now is not None else (0 if move > 0 else len(options) - 1)

    def chosen_item(number: int | None, step: str) -> Any:
        with lock:
            items = results.items(step)
        return None if number is None or number >= len(items) else items[number]

    @app.callback(Output("facts", "children"), Input("item", "value"), State("step", "value"), prevent_initial_call=True)
    def tell(number: int | None, step: str) -> Any:
        """Facts have a callback of their own: Dash drops the answer to a click if the map's redrawing asks the same callback."""
        item = chosen_item(number, step)
        return None if item is None else facts_table(item)

    @app.callback(
        Output("window", "data"),
        Input("item", "value"),
        Input("whole", "n_clicks"),
        Input("map", "relayoutData"),
        State("step", "value"),
        State("window", "data"),
        prevent_initial_call=True,
    )
    def move(number: int | None, _whole: Any, zoomed: Any, step: str, now: Any) -> Any:
        if ctx.triggered_id == "whole":
            return None
        if ctx.triggered_id == "map":
            return zoom(zoomed, now)
        item = chosen_item(number, step)
        return no_update if item is None else list(item.window())

    @app.callback(
        Output("wall", "figure"),
        Output("map", "figure"),
        Output("note", "children"),
        Input("step", "value"),
        Input("layer", "value"),
        Input("surface", "value"),
        Input("shown", "value"),
        Input("item", "value"),
        Input("window", "data"),
        Input("beside", "value"),
        Input("border", "value"),
    )
    def draw(
        step: str, key: str | None, surface: str, shown: list[str], number: int | None, window: Any, choice: str, share: float
    ) -> Any:
        layers = {layer.key: layer for layer in results.layers(step)}
        if key not in layers:
            return no_update, no_update, no_update
        with lock:
            part = ViewWindow(*window) if window else None
            second = (Pair(results, other), choice, share / 100) if choice else None
            return pictures(results, step, surface, layers[key], shown, number, part, second)


def pictures(
    results: Results,
    step: str,
    surface: str,
    layer: Layer,
    shown: list[str],
    number: int | None,
    window: ViewWindow | None,
    second: tuple[Pair, str, float] | None = None,
) -> tuple[Any, Any, str]:
    """Draw a part of the wall in 3D and as a map, and make a note about both, for the page of `scarpsim view`.

    Parameters
    ----------
    results : Results
        What is shown.
    step, surface : str
        Keys of the state (such as an epoch) and of the surface to draw.
    layer : Layer
        The quantity that gives the colours.
    shown : list of str
        What to draw: any of "surface", "points", "block", "detection", "event" and "scene change".
    number : int or None
        Index of the selected block, detection, event or change; None: no one.
    window : ViewWindow or None
        Part of the wall; None: all of it.
    second : (Pair, str, float), optional
        To compare two states left and right of a vertical border: what the right side can show, the key of the state that
        it shows, and the share of the picture's width, 0 to 1, that is left of the border.

    Returns
    -------
    figure, figure and str
        The wall in 3D, the map, and the note.
    """
    patch = results.patch(step, surface, layer, window, CELLS)
    sides = ""
    if second is not None:
        pair, choice, share = second
        at = border(patch, share)
        patch = split_patch(patch, pair.patch(choice, surface, layer, window, CELLS), share)
        own = f"{results.title}, {results.steps[step]}" if choice.startswith(OTHER) else results.steps[step]
        sides = f"left of the border: {own}; right of it: {pair.choices[choice]}, on the same colours"
    points = results.points(step, layer, window, POINTS) if "points" in shown else None
    items = results.items(step)
    flat = map_figure(patch, items, layer, shown, window, number)
    if second is not None:
        flat.add_vline(x=at, line={"color": "#000000", "width": 1.5})
    cells = (
        f"a cell shows the mean of {patch.pooled} x {patch.pooled} pixels; zoom the map to see each" if patch.pooled > 1 else ""
    )
    thinned = f"{len(points.points):,} points are shown, {100 * points.share:.2f} % of all" if points is not None else ""
    outside = "where there is no data the map is grey and the wall open"
    note = ". ".join(part[0].upper() + part[1:] for part in (sides, cells, thinned, outside) if part) + "."
    return wall_figure(patch, points, items, layer, shown, number), flat, note


def following(steps: list[str], step: str) -> str:
    """Return the key of the next state (such as an epoch), to play all states in turn; after the last comes the first.

    steps: keys of all states. step: key of the present one.
    """
    return steps[(steps.index(step) + 1) % len(steps)]


def clicked(data: Any) -> int | None:
    """Return the index of the block or other item that the user clicked in a picture; None for a click on the wall itself.

    data: what Plotly reports of the click.
    """
    point = (data or {}).get("points", [{}])[0]
    known = point.get("customdata")
    return int(known[0]) if isinstance(known, list) and len(known) == 1 and "text" in point else None


def zoom(change: Any, now: Any) -> Any:
    """Return the part of the wall to show after the user zoomed or moved the map: [x0, x1, y0, y1], m; None for the whole wall.

    change: what Plotly reports of the map's axes. now: the part shown so far. If nothing changed, returns Dash's `no_update`.
    """
    change = change or {}
    if change.get("xaxis.autorange") or change.get("yaxis.autorange"):
        return None
    keys = [f"{axis}.range[{end}]" for axis in ("xaxis", "yaxis") for end in (0, 1)]
    if not all(key in change for key in keys):
        return no_update
    window = [float(change[key]) for key in keys]
    return no_update if window == now else window


def facts_table(item: Item) -> html.Div:
    """Make the table of a selected item's properties, such as the volume of a block, under its name."""
    rows = [html.Tr([html.Th(name), html.Td(value)]) for name, value in item.facts.items()]
    return html.Div([html.H2(item.name), html.Table(html.Tbody(rows))])


def _first_beside(other: Results | None) -> str:
    """Return the initial choice of what is shown beside: the first step of a second run."""
    return _NOTHING if other is None else f"{OTHER}{next(iter(other.steps))}"


def _kinds(results: Results) -> list[str]:
    """Return the kinds of items in the first steps."""
    found = {item.kind for step in list(results.steps)[:20] for item in results.items(step)}
    return [kind for kind in ITEM_TRACES if kind in found]


def _control(name: str, part: Any) -> html.Label:
    """Label a control."""
    return html.Label([html.Span(name), part])


def _options(choices: Any) -> list[dict[str, str]]:
    """Convert choices to the options of a dropdown."""
    return [{"label": label, "value": key} for key, label in choices.items()]

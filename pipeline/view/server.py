"""Serve the local page of `scarpsim view` with Dash, with all its scripts, to this machine only; nothing is downloaded."""

from __future__ import annotations

import hmac
import html
import io
import secrets
import threading
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import dash
import flask
from werkzeug.serving import BaseWSGIServer, WSGIRequestHandler, make_server

from pipeline.view.gap_results import GapResults
from pipeline.view.monitor_results import MONITOR_FILE, MonitorResults
from pipeline.view.page import layout, register_callbacks
from pipeline.view.results import Results
from pipeline.view.run_results import RunResults
from pipeline.view.split_view import check_same_wall
from pipeline.view.tile_results import TileResults
from scene.common.errors import InputError, one_line

HOST = "127.0.0.1"
_NO_TOKEN = "Use the complete address that scarpsim view printed, with its token."
"""Answer to a request without the token."""
_OWN_NAMES = {"127.0.0.1", "localhost"}
_POLICY = {
    "default-src": "'none'",
    "script-src": "'self' {inline}",
    "style-src": "'self' 'unsafe-inline'",
    "img-src": "'self' data: blob:",
    "font-src": "'self' data:",
    "connect-src": "'self'",
    "base-uri": "'none'",
    "form-action": "'none'",
    "frame-ancestors": "'none'",
}
"""What the page may load and run: its own scripts and, by their hashes ({inline}), the inline scripts with which Dash starts.
Plotly sets styles from scripts and saves pictures through data and blob addresses."""


def open_results(folder: Path, detections: Path | None = None) -> Results:
    """Open a folder of results for `scarpsim view`: of `simulate`, `gap` or `monitor`, or a split of a data set.

    Its files tell which kind it is. detections: folder of `scarpsim detect`, to be shown on a simulated run. Raises InputError if
    the folder cannot be shown.
    """
    if not folder.is_dir():
        raise InputError("there is no such folder", where=str(folder), remedy="give a folder with results of a scarpsim command")
    if (folder / "run.json").exists():
        return RunResults(folder, detections)
    if detections:
        raise InputError(
            "detections can only be shown with a simulated run",
            where="--detections",
            remedy="leave it out, or give the folder of the run in which they were found",
        )
    if (folder / "gap.json").exists():
        return GapResults(folder)
    if (folder / MONITOR_FILE).exists():
        return MonitorResults(folder)
    if (folder / "annotations.json").exists():
        return TileResults(folder)
    raise InputError(
        "the folder contains no results that can be shown",
        where=str(folder),
        allowed="a run (run.json), a result of scarpsim gap (gap.json) or monitor (monitor.json), "
        "a split of a data set (annotations.json)",
        remedy="give one of these folders",
    )


def make_app(results: Results, token: str, other: Results | None = None) -> dash.Dash:
    """Make the web page of `scarpsim view` as a Dash application, which refuses requests without the token.

    results: what is shown. token: secret in the page's address that grants access. other: a second run of the same wall, shown
    beside it.
    """
    app = dash.Dash(
        __name__,
        serve_locally=True,
        title=html.escape(f"scarpsim: {results.title}"),  # Dash does not escape it
        update_title="",
        assets_folder=str(Path(__file__).parent / "assets"),
        on_error=_tell,
    )
    app.index_string = app.index_string.replace("<html>", '<html lang="en">')
    app.layout = layout(results, other)
    register_callbacks(app, results, threading.Lock(), other)
    app.server.before_request(_refuse_other_names)
    app.server.before_request(_refuse_strangers(token))
    app.server.after_request(_with_headers(app.csp_hashes()))
    return app


def make_page_server(results: Results, port: int, token: str, other: Results | None = None) -> BaseWSGIServer:
    """Make the local web server of `scarpsim view`, which other machines cannot reach.

    Parameters
    ----------
    results : Results
        What the page shows.
    port : int
        Port, or 0 for any free one.
    token : str
        Secret in the page's address that grants access.
    other : Results, optional
        A second run of the same wall, shown beside it.

    Raises
    ------
    InputError
        If the port cannot be used.
    """
    try:
        with redirect_stderr(io.StringIO()):  # werkzeug's own message is long
            return make_server(HOST, port, make_app(results, token, other).server, threaded=True, request_handler=_Silent)
    except (OSError, SystemExit, OverflowError):
        raise InputError(
            f"port {port} cannot be used", where="--port", remedy="choose another port, or 0 for any port that is free"
        ) from None


def open_second(folder: Path, first: Results) -> Results:
    """Open a second run of the same wall, to be shown beside the first.

    folder: the second run. first: the opened first run. Raises InputError if either is not a simulated run, or if they have
    different walls or wall frames.
    """
    second = open_results(folder)
    if not isinstance(first, RunResults) or not isinstance(second, RunResults):
        raise InputError(
            "only two runs of one wall can be shown side by side",
            where=str(folder),
            remedy="give two run folders that scarpsim simulate made of one wall",
        )
    check_same_wall(first.world_to_wall, second.world_to_wall, first.extent_m, str(folder))
    return second


def serve(folder: Path, second: Path | None, detections: Path | None, port: int, *, open_browser: bool) -> None:
    """Show a folder of results in the browser until the user interrupts: the command `scarpsim view`.

    Parameters
    ----------
    folder : Path
        Folder of results.
    second : Path or None
        Folder of a second run of the same wall, to be shown beside it.
    detections : Path or None
        Folder of `scarpsim detect`, to be shown on a simulated run.
    port : int
        Port, or 0 for any free one.
    open_browser : bool
        Whether to open the page in the browser.

    Raises
    ------
    InputError
        If a folder cannot be shown or the port cannot be used.
    """
    token = secrets.token_urlsafe(24)
    results = open_results(folder, detections)
    server = make_page_server(results, port, token, open_second(second, results) if second else None)
    address = f"http://{HOST}:{server.server_port}/?token={token}"
    print(f"{address} shows {folder}; Ctrl-C ends it", flush=True)  # noqa: T201  (the command's output)
    if open_browser:
        webbrowser.open(address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        return
    finally:
        server.server_close()


def _tell(error: Exception) -> None:
    """Show an error on the page; the pictures stay as they are."""
    fault = "" if isinstance(error, InputError) else f"internal error, {type(error).__name__}: "
    dash.set_props("note", {"children": f"{fault}{one_line(str(error))}"})


def _refuse_other_names() -> Any:
    """Refuse requests under another host name, by which a foreign page could reach this one."""
    name = flask.request.host.rpartition(":")[0] or flask.request.host
    return None if name in _OWN_NAMES else flask.abort(403)


def cookie_name(host: str) -> str:
    """Return the name of the cookie by which the viewer's page recognises its browser; it contains the port.

    A browser sends cookies to all ports of a machine, so pages on different ports need different names. host: host and port of
    the request, such as "localhost:8050".
    """
    return f"scarpsim_view_{host.rpartition(':')[2]}"


def _refuse_strangers(token: str) -> Callable[[], Any]:
    """Make a check that grants access by the token in the address, and from then on by a cookie.

    Another user of the machine who finds the port gets nothing.
    """

    def refuse() -> Any:
        given = flask.request.args.get("token", "")
        if hmac.compare_digest(given.encode(), token.encode()):
            answer = flask.redirect(flask.request.path)  # keeps the token out of the browser's history
            answer.set_cookie(cookie_name(flask.request.host), token, httponly=True, samesite="Strict")
            return answer
        known = flask.request.cookies.get(cookie_name(flask.request.host), "")
        return None if hmac.compare_digest(known.encode(), token.encode()) else flask.abort(403, _NO_TOKEN)

    return refuse


def _with_headers(inline: Sequence[str]) -> Callable[[flask.Response], flask.Response]:
    """Make a function that adds security headers to each answer. inline: hashes of the scripts in the page itself."""
    policy = "; ".join(f"{key} {value}" for key, value in _POLICY.items()).format(inline=" ".join(inline))

    def add(response: flask.Response) -> flask.Response:
        response.headers["Content-Security-Policy"] = policy
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        return response

    return add


class _Silent(WSGIRequestHandler):
    """A request handler that logs nothing."""

    def log(self, type: str, message: str, *args: Any) -> None:
        """Do nothing."""

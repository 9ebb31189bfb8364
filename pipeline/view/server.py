"""The local page of `scarpsim view`: Dash serves it, with its scripts, to this machine alone; nothing is fetched."""

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

from pipeline.view.beside import check_same_wall
from pipeline.view.gap_results import GapResults
from pipeline.view.monitor_results import MONITOR_FILE, MonitorResults
from pipeline.view.page import layout, register_callbacks
from pipeline.view.results import Results
from pipeline.view.run_results import RunResults
from pipeline.view.tile_results import TileResults
from scene.common.errors import InputError, one_line

HOST = "127.0.0.1"
_NO_TOKEN = "Take the whole address that scarpsim view said, with its token."
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
"""What the page may load and run: its own scripts and, by their hashes ({inline}), the lines in the page by which Dash starts
them. Plotly sets styles from scripts and saves pictures through data and blob addresses."""


def open_results(folder: Path, detections: Path | None = None) -> Results:
    """What lies in a folder, told by its files; raises InputError where it is none of those that can be looked at."""
    if not folder.is_dir():
        raise InputError("there is no such folder", where=str(folder), remedy="give the folder that a command filled")
    if (folder / "run.json").exists():
        return RunResults(folder, detections)
    if detections:
        raise InputError("belong to a run", where="--detections", remedy="leave it out, or give the run's folder")
    if (folder / "gap.json").exists():
        return GapResults(folder)
    if (folder / MONITOR_FILE).exists():
        return MonitorResults(folder)
    if (folder / "annotations.json").exists():
        return TileResults(folder)
    allowed = (
        "a run (run.json), a result of scarpsim gap (gap.json) or monitor (monitor.json), "
        "a split of a data set (annotations.json)"
    )
    raise InputError("holds nothing to look at", where=str(folder), allowed=allowed)


def make_app(results: Results, token: str, other: Results | None = None) -> dash.Dash:
    """The page on `results`, for those who know the token; other: a second run of the same wall."""
    app = dash.Dash(
        __name__,
        serve_locally=True,
        title=html.escape(f"scarpsim: {results.title}"),  # Dash puts it into the page as it is
        update_title="",
        assets_folder=str(Path(__file__).parent / "assets"),
        on_error=_tell,
    )
    app.layout = layout(results, other)
    register_callbacks(app, results, threading.Lock(), other)
    app.server.before_request(_refuse_other_names)
    app.server.before_request(_refuse_strangers(token))
    app.server.after_request(_with_headers(app.csp_hashes()))
    return app


def make_page_server(results: Results, port: int, token: str, other: Results | None = None) -> BaseWSGIServer:
    """The page's server at `port` (0: any that is free); raises InputError where the port is taken."""
    try:
        with redirect_stderr(io.StringIO()):  # where werkzeug says the same at length
            return make_server(HOST, port, make_app(results, token, other).server, threaded=True, request_handler=_Silent)
    except (OSError, SystemExit, OverflowError):
        remedy = "choose another, or 0 for any that is free"
        raise InputError(f"port {port} cannot be used", where="--port", remedy=remedy) from None


def open_second(folder: Path, first: Results) -> Results:
    """A second run of the wall of `first`; raises InputError where either is no run, or the walls or frames differ."""
    second = open_results(folder)
    if not isinstance(first, RunResults) or not isinstance(second, RunResults):
        raise InputError("is to be shown beside another", where=str(folder), allowed="two runs of one wall")
    check_same_wall(first.world_to_wall, second.world_to_wall, first.extent_m, str(folder))
    return second


def serve(folder: Path, second: Path | None, detections: Path | None, port: int, *, open_browser: bool) -> None:
    """Show a folder until interrupted; second: a run to be put beside it."""
    token = secrets.token_urlsafe(24)
    results = open_results(folder, detections)
    server = make_page_server(results, port, token, open_second(second, results) if second else None)
    address = f"http://{HOST}:{server.server_port}/?token={token}"
    print(f"{address} shows {folder}; Ctrl-C ends it", flush=True)  # noqa: T201  (what the command is asked for)
    if open_browser:
        webbrowser.open(address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        return
    finally:
        server.server_close()


def _tell(error: Exception) -> None:
    """Say on the page what is wrong with a file that it was to show; the pictures stay as they are."""
    fault = "" if isinstance(error, InputError) else f"unexpected fault of the program, {type(error).__name__}: "
    dash.set_props("note", {"children": f"{fault}{one_line(str(error))}"})


def _refuse_other_names() -> Any:
    """A page elsewhere that reaches this one under a name of its own gets nothing."""
    name = flask.request.host.rpartition(":")[0] or flask.request.host
    return None if name in _OWN_NAMES else flask.abort(403)


def cookie_name(host: str) -> str:
    """Of the page at a host and port: a browser sends its cookies to all ports of a machine."""
    return f"scarpsim_view_{host.rpartition(':')[2]}"


def _refuse_strangers(token: str) -> Callable[[], Any]:
    """Whoever comes with the address that the command said gets a cookie, and with it all else; another user of the machine,
    who finds the port, gets nothing."""

    def refuse() -> Any:
        given = flask.request.args.get("token", "")
        if hmac.compare_digest(given.encode(), token.encode()):
            answer = flask.redirect(flask.request.path)  # the token leaves the address, and so the browser's history
            answer.set_cookie(cookie_name(flask.request.host), token, httponly=True, samesite="Strict")
            return answer
        known = flask.request.cookies.get(cookie_name(flask.request.host), "")
        return None if hmac.compare_digest(known.encode(), token.encode()) else flask.abort(403, _NO_TOKEN)

    return refuse


def _with_headers(inline: Sequence[str]) -> Callable[[flask.Response], flask.Response]:
    """What each answer tells the browser to refuse. inline: hashes of the scripts in the page itself."""
    policy = "; ".join(f"{key} {value}" for key, value in _POLICY.items()).format(inline=" ".join(inline))

    def add(response: flask.Response) -> flask.Response:
        response.headers["Content-Security-Policy"] = policy
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        return response

    return add


class _Silent(WSGIRequestHandler):
    """Writes no line for each request."""

    def log(self, type: str, message: str, *args: Any) -> None:
        """Nothing."""

"""Export a run's wall in perspective: an epoch as a picture, all epochs and the scan as animations."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image

from pipeline.export.exported_run import ExportedRun
from pipeline.export.perspective import Image as Pixels
from pipeline.export.perspective import PerspectiveView, draw_wall
from pipeline.formats.files.atomic import write_bytes, writing
from pipeline.report.figures import COLOURS, DIFFERENCE_LABEL, SCALE_SIGMAS, SEQUENTIAL
from pipeline.report.page import litres, millimetres
from pipeline.report.plain_text import plain_text
from pipeline.report.progress import Progress
from pipeline.report.words import counted
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh

_DPI = 100
_TITLE_PX, _BAR_PX = 46, 78
_MOST_NUMBERED = 60
_EPOCH_MS, _SCAN_MS, _LAST_MS = 1200, 80, 2500
_WHOLE_MS, _LEAST_MS = 20_000, 200
"""Duration at which the epochs of a long series are shown faster, and the shortest for one."""
_SCAN_FRAMES, _SCAN_POINTS = 48, 400_000
_ANIMATED_PX, _COLOURS_OF_GIF = 900, 96
_LONGEST_SCAN_S = 1e6
"""Longest plausible duration of a scan: eleven days."""
_NIGHT, _BEAM = 26, np.array([255, 150, 30], dtype=np.uint8)


def save_picture(run: ExportedRun, number: int, path: Path, width: int = 1280) -> None:
    """Write a PNG of the wall of a run's epoch in perspective, coloured by the difference, with its largest blocks numbered.

    run: the run. number: of the epoch; 0 is the reference, drawn as bare rock. path: the PNG file. width: of the picture,
    px. The blocks have the numbers that they have in the report.
    """
    reference = run.surface(0)
    view = PerspectiveView.on(reference.vertices, width)
    drawn = _reference_picture(reference, view, run.limit_m(1)) if number == 0 else _epoch_picture(run, number, view)
    write_bytes(path, _png(drawn))


def save_epochs(run: ExportedRun, path: Path, progress: Progress) -> None:
    """Write an animated GIF of a run's wall, epoch by epoch from the reference on, with one colour scale for the differences.

    run: the run. path: the GIF file. progress: receives the progress.
    """
    numbers = range(1, run.last + 1)
    limit = max(run.limit_m(number) for number in numbers)
    with progress.stage("reference"):
        reference = run.surface(0)
        view = PerspectiveView.on(reference.vertices, _ANIMATED_PX)
        frames = [_reference_picture(reference, view, limit)]
    for number in numbers:
        with progress.stage(f"epoch {number}"):
            frames.append(_epoch_picture(run, number, view, limit))
    each = int(np.clip(_WHOLE_MS / len(numbers), _LEAST_MS, _EPOCH_MS))
    _write_gif(path, frames, [each] * len(numbers) + [_LAST_MS])


def save_scan(run: ExportedRun, number: int, path: Path) -> None:
    """Write an animated GIF that shows how a laser scanner records the points of an epoch, line by line.

    run: the run. number: of the epoch. path: the GIF file. Points are coloured by their distance from the wall plane.
    Raises InputError for a run of a stereo pair, which records all its points at once.
    """
    if run.record["sensor"] != "tls":
        raise InputError(
            "this is a run of a stereo pair, whose points are all recorded at once, so there is no scan to animate",
            where=str(run.folder),
            allowed="a run of a laser scanner",
            remedy="export `epochs` or `picture` instead",
        )
    cloud = run.points(number)
    count, clock = len(cloud.points), np.zeros(len(cloud.points)) if cloud.gps_time is None else cloud.gps_time
    if not np.isfinite(clock).all() or np.ptp(clock) > _LONGEST_SCAN_S:
        raise InputError(
            f"the points of epoch {number} have no valid times",
            where=str(run.folder),
            allowed=f"a number for each point, in seconds; all within {_LONGEST_SCAN_S:g} s",
            remedy="make the run again with scarpsim simulate, in another folder",
        )
    order = np.argsort(clock, kind="stable")[:: max(1, count // _SCAN_POINTS)]
    places, time = cloud.points[order], clock[order]
    view = PerspectiveView.on(places, _ANIMATED_PX)
    ends = np.linspace(0, len(places), min(_SCAN_FRAMES, len(places)) + 1).astype(int)[1:]
    frames = []
    for start, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        came = f"{end * count / len(places) / 1e6:.2f} of {count / 1e6:.2f} million points"
        title = f"{came}, {time[end - 1] - time[0]:.1f} s"
        frames.append(_framed(_cloud_pixels(view, places, start, end), title, None))
    frames.append(_framed(_cloud_pixels(view, places, len(places), len(places)), title, None))
    _write_gif(path, frames, [_SCAN_MS] * len(ends) + [_LAST_MS])


def _cloud_pixels(view: PerspectiveView, places: FloatArray, start: int, end: int) -> Pixels:
    """Draw the points up to `end` (h, w, 3), nearer ones over farther ones; those from `start` on have the colour of the beam."""
    low, high = np.quantile(places[:, 2], [0.02, 0.98])
    shown = places[:end]
    at, ahead = view.project(shown)
    column, row = np.floor(at).astype(int).T
    colours = SEQUENTIAL(np.clip((shown[:, 2] - low) / max(high - low, 1e-9), 0, 1), bytes=True)[:, :3]
    colours[start:] = _BEAM
    kept = np.flatnonzero((column >= 0) & (column < view.width) & (row >= 0) & (row < view.height))
    kept = kept[np.argsort(-ahead[kept], kind="stable")]
    pixels = np.full((view.height, view.width, 3), _NIGHT, dtype=np.uint8)
    pixels[row[kept], column[kept]] = colours[kept]
    return pixels


def _reference_picture(surface: TriangleMesh, view: PerspectiveView, limit: float) -> Image.Image:
    """Draw the reference."""
    return _framed(draw_wall(view, surface, None, None, limit), "Reference: before rocks fall", limit)


def _epoch_picture(run: ExportedRun, number: int, view: PerspectiveView, limit: float | None = None) -> Image.Image:
    """Draw an epoch. limit: where the colour scale ends, m; by default that of the epoch's own map."""
    limit = run.limit_m(number) if limit is None else limit
    values, grid = run.difference(number)
    blocks = run.blocks(number)
    volume, noise = sum(block["volume_m3"] for block in blocks), millimetres(run.limit_m(number) / SCALE_SIGMAS)
    time = str(run.record["epochs"][number].get("time", ""))[:16].replace("T", " ")
    named = f"Epoch {number}, {time}" if time else f"Epoch {number}"
    title = f"{named}: {counted(len(blocks), 'block')} of {litres(volume)} l fell; noise {noise} (NMAD)"
    labels = {block["label"]: np.array(block["position_m"]) for block in blocks[:_MOST_NUMBERED]}
    pixels = draw_wall(view, run.surface(number), values, grid, limit)
    return _framed(pixels, title, limit, {label: view.project(place[None])[0][0] for label, place in labels.items()})


def _framed(pixels: Pixels, title: str, limit: float | None, numbers: dict[int, FloatArray] | None = None) -> Image.Image:
    """Add a title above the pixels and, with a limit in m, the colour scale beneath."""
    height, width, _ = pixels.shape
    bar = 0 if limit is None else _BAR_PX
    whole = height + _TITLE_PX + bar
    figure = Figure(figsize=(width / _DPI, whole / _DPI), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, bar / whole, 1, height / whole))
    axes.imshow(pixels, interpolation="nearest", aspect="auto", extent=(0, width, height, 0))
    axes.set_axis_off()
    for label, (column, row) in (numbers or {}).items():
        text = axes.annotate(f"{label}", (column, row), (6, 6), textcoords="offset points", fontsize=8, annotation_clip=True)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
    figure.text(0.5, 1 - 0.5 * _TITLE_PX / whole, title, ha="center", va="center", fontsize=11)
    if limit is not None:
        place = figure.add_axes((0.25, 0.62 * bar / whole, 0.5, 0.16 * bar / whole))
        scale = ScalarMappable(Normalize(-1e3 * limit, 1e3 * limit), COLOURS)
        figure.colorbar(scale, cax=place, orientation="horizontal", extend="both").set_label(DIFFERENCE_LABEL, fontsize=9)
        place.tick_params(labelsize=8)
    with plain_text(figure):
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return Image.open(buffer).convert("RGB")


def _png(picture: Image.Image) -> bytes:
    """Return a picture as PNG with a palette."""
    buffer = io.BytesIO()
    picture.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _write_gif(path: Path, frames: Sequence[Image.Image], milliseconds: list[int]) -> None:
    """Write an animated GIF with one palette for all frames, so that what does not move keeps its colour."""
    sample = Image.new("RGB", (frames[0].width, sum(frame.height for frame in (frames[0], frames[-1]))))
    sample.paste(frames[0], (0, 0))
    sample.paste(frames[-1], (0, frames[0].height))
    palette = sample.quantize(_COLOURS_OF_GIF, Image.Quantize.MEDIANCUT)
    drawn = list(_on_palette(frames, palette))
    with writing(path) as temporary, temporary.open("wb") as file:
        drawn[0].save(file, "GIF", save_all=True, append_images=drawn[1:], duration=milliseconds, loop=0, optimize=True)


def _on_palette(frames: Sequence[Image.Image], palette: Image.Image) -> Iterator[Image.Image]:
    """Convert frames to the palette."""
    for frame in frames:
        yield frame.quantize(palette=palette, dither=Image.Dither.NONE)

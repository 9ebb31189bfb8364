"""Write the report of `scarpsim monitor`: maps, events, volumes over time, and the registration of each epoch."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from pipeline.formats.files.atomic import write_bytes, write_text
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.monitoring.events import LEAST_PIXELS
from pipeline.monitoring.magnitude import PowerLaw, fit_power_law
from pipeline.monitoring.model import compared_in_words
from pipeline.monitoring.products import Followed, Result, event_raster
from pipeline.monitoring.records import CAUTION, KEPT, points_note
from pipeline.monitoring.significance import NORMAL_95
from pipeline.monitoring.site import WallView
from pipeline.report.figures import blocks_figure, difference_figure, hillshade_figure, label_axes, png_bytes
from pipeline.report.map_styles import difference_style, quantity_style
from pipeline.report.page import template
from pipeline.report.words import counted

_SIGMAS_SHOWN = 6.0
_LARGEST_SHOWN = 24
_ROWS_SHOWN = 500
_EPOCHS_FOR_LAW = 3
"""Epochs, the reference among them, from which on a magnitude-frequency law is drawn."""


def write_report(result: Result) -> None:
    """Write report.html of a finished `scarpsim monitor`, its pictures as files, and styles of the maps for GIS programs."""
    pictures: dict[str, bytes] = {}
    for view in result.site.views:
        pictures[f"reference{view.suffix}.png"] = hillshade_figure(view.raster.height, view.grid)
    for epoch in result.epochs:
        pictures |= epoch_pictures(epoch, result.site.views, result.folder)
    law = None
    if len(result.sources) >= _EPOCHS_FOR_LAW:
        pictures["volumes.png"] = _volumes_figure(result)
        volumes = list(_missing_volumes(result).values())
        law = fit_power_law(volumes)
        if law is not None:
            pictures["magnitude_frequency.png"] = _law_figure(volumes, law)
    for name, png in pictures.items():
        if not name.startswith(("map_", "events_")):  # those of epochs are written already
            write_bytes(result.folder / name, png)
    rows = result.rows()
    text = template("monitoring/report.html.jinja").render(
        result=result,
        epochs=[_about(epoch, result) for epoch in result.epochs],
        headline=headline(result),
        pictures=pictures,
        rows=rows[:_ROWS_SHOWN],
        more=max(len(rows) - _ROWS_SHOWN, 0),
        law=None if law is None else law_in_words(law),
        two_digits=two_digits,
        least_pixels=LEAST_PIXELS,
        least_m2=LEAST_PIXELS * result.site.grid.gsd**2,
        read=_inputs(result),
        crs=_name_of_crs(result.site.crs),
    )
    write_text(result.folder / "report.html", text)


def _inputs(result: Result) -> list[dict[str, Any]]:
    """What was understood of each epoch, the reference first: name, number of points, time, and how the time is known."""
    points = [result.site.points, *(epoch.record.points for epoch in result.epochs)]
    return [
        {"name": source.name, "points": count, "time": source.time.text or "unknown", "how": source.time.source}
        for source, count in zip(result.sources, points, strict=True)
    ]


def _name_of_crs(wkt: str) -> str:
    """Return the name of a coordinate system; empty for none."""
    from pyproj import CRS

    return str(CRS.from_wkt(wkt).name) if wkt else ""


def headline(result: Result) -> list[str]:
    """Return one sentence for each epoch: what fell, what was added, and the level of detection of a pixel.

    A caution on the reference comes first, if there is one.
    """
    doubts = _cautions(result.site.notes)
    told = [f"Reference, {result.site.source.name}:{doubts}"] if doubts else []
    for epoch in result.epochs:
        when = f" ({epoch.source.time.text})" if epoch.source.time.when else ""
        parts = [_kind_in_words(epoch, kind) for kind in ("missing", "added")]
        found = "; ".join(part for part in parts if part) or "no change beyond the level of detection"
        marked = sum(bool(region.marks) for region in epoch.regions)
        doubtful = f" Edges, vegetation or noise may explain {marked} of {len(epoch.regions)} events (marked)." if marked else ""
        told.append(
            f"Epoch {epoch.number}, {epoch.source.name}{when}: {found}. The level of detection of "
            f"a single pixel is {1e3 * epoch.record.level_m:.1f} mm (95 %, median).{doubtful}{_cautions(epoch.record.notes)}"
        )
    return told


def next_step(result: Result) -> str:
    """Return a sentence with the commands that find out why the noise is not as the scanner's model predicts it.

    It is empty for meshes and elevation models, whose points the scanner did not measure.
    """
    if any(source.is_surface for source in result.sources):
        return ""
    gap, calibration = (f"{result.folder}_{name}" for name in ("gap", "calibration"))
    scanner = shlex.join(["scarpsim", "gap", str(result.folder), "--out", gap])
    noise = shlex.join(["scarpsim", "calibrate", f"{gap}/measurement", "--out", calibration])
    unknown = result.options.position is None and result.options.direction is not None
    place = " (add --position with the place of the scanner, X,Y,Z in m, if no file states it)" if unknown else ""
    return f"Find out with `{scanner}`{place}, which diagnoses the stable rock, and fit the noise there with `{noise}`."


def _cautions(notes: Iterable[str]) -> str:
    """Return the cautions among some remarks, without which the numbers would mislead, as sentences with a space before each."""
    return "".join(f" {note[0].upper()}{note[1:]}." for note in notes if note.startswith(CAUTION))


def law_in_words(law: PowerLaw) -> str:
    """State the magnitude-frequency law of the rockfalls, with the 95 % interval of its exponent, as a sentence."""
    return (
        f"{law.count} rockfalls of {law.smallest_m3:.3g} m³ and more follow N(> V) ~ V^-{law.exponent:.2f} "
        f"(95 % interval {law.low:.2f} to {law.high:.2f})."
    )


def _kind_in_words(epoch: Followed, kind: str) -> str:
    regions = [region for region in epoch.regions if region.kind == kind]
    if not regions:
        return ""
    volume = sum(region.volume_m3 for region in regions)
    sigma = float(np.sqrt(sum(region.volume_std_m3**2 for region in regions)))
    what = "of missing rock" if kind == "missing" else "of added material"
    places = counted(len(regions), "place")
    return f"{volume:.3g} ± {two_digits(NORMAL_95 * sigma)} m³ {what} in {places}"


def two_digits(value: float) -> str:
    """Format a positive number with two significant digits, also where the last one is zero, such as 0.050."""
    return f"{value:#.2g}".rstrip(".")


def _about(epoch: Followed, result: Result) -> dict[str, Any]:
    record = epoch.record
    registration = record.registration
    shift = 1e3 * float(np.linalg.norm(registration["sigma_translation_m"]))
    registered = (
        f"{epoch.source.name} was registered on {result.site.source.name} by {registration['stable_pixels']:,} stable pixels. "
        f"Their differences have an RMS of {1e3 * registration['rms_m']:.1f} mm. "
        f"The standard deviation of the shift is {shift:.2g} mm."
    )
    levels = record.level_m, record.predicted_level_m
    predicted = None if np.isnan(record.predicted_level_m) else compared_in_words(*levels, next_step(result))
    return {"number": epoch.number, "registered": registered, "predicted": predicted, "notes": record.notes}


def epoch_pictures(epoch: Followed, views: Sequence[WallView], folder: Path) -> dict[str, bytes]:
    """Draw and write map, gallery of events and map styles of an epoch, unless the folder has them from an earlier call.

    Parameters
    ----------
    epoch : Followed
        Result of the epoch, whose points are written already.
    views : sequence of WallView
        The separately mapped parts of the wall.
    folder : Path
        Folder of the results, which has the epoch's difference maps and levels of detection.

    Returns
    -------
    dict
        PNG files by name.
    """
    key = points_note(folder, epoch.number).read_text(encoding="utf-8")
    pictures: dict[str, bytes] = {}
    for view in views:
        note = folder / KEPT / f"pictures_{epoch.number:03d}{view.suffix}.txt"
        found = _drawn_before(note, key, folder)
        if found is None:
            found = _drawn(epoch, view, folder)
            for name, png in found.items():
                write_bytes(folder / name, png)
            write_text(note, "\n".join([key, *found]))
        pictures |= found
    return pictures


def _drawn_before(note: Path, key: str, folder: Path) -> dict[str, bytes] | None:
    """Read the pictures that a note lists; None if they are missing or were drawn for another state of the epoch."""
    if not note.is_file():
        return None
    before, *names = note.read_text(encoding="utf-8").splitlines()
    if before != key or not all((folder / name).is_file() for name in names):
        return None
    return {name: (folder / name).read_bytes() for name in names}


def _drawn(epoch: Followed, view: WallView, folder: Path) -> dict[str, bytes]:
    """Draw map and gallery of an epoch in one view, and write styles of its maps."""
    grid, place = view.grid, f"{epoch.number:03d}{view.suffix}"
    difference, _ = read_geotiff(folder / f"difference_{place}.tif")
    level, _ = read_geotiff(folder / f"lod_{place}.tif")
    sigma = max(epoch.record.level_m / NORMAL_95, 1e-6)
    difference_style(folder / f"difference_{place}.tif", _SIGMAS_SHOWN * sigma)
    quantity_style(folder / f"lod_{place}.tif", level, "mm", 1e3)
    labels = event_raster(epoch.regions, view)
    captions = {
        region.identity: f"{region.volume_m3:.3g} m³" if region.volume_m3 >= 0.1 else f"{1e3 * region.volume_m3:.3g} l"
        for region in [each for each in epoch.regions if each.view == view.number][:_LARGEST_SHOWN]
    }
    found = {f"map_{place}.png": difference_figure(difference, grid, labels, sigma)}
    gallery = blocks_figure(difference, grid, labels, sigma, captions)
    return found if gallery is None else found | {f"events_{place}.png": gallery}


def _missing_volumes(result: Result) -> dict[int, float]:
    """Volume of each rockfall, m3, when it was first seen, by its event's number."""
    found: dict[int, float] = {}
    for epoch in result.epochs:
        for region in epoch.regions:
            if region.kind == "missing" and not region.marks:
                found.setdefault(region.identity, region.volume_m3)
    return found


def _volumes_figure(result: Result) -> bytes:
    figure = Figure(figsize=(8.0, 3.4), dpi=120, layout="constrained")
    axes = figure.subplots()
    timed = all(epoch.source.time.when for epoch in result.epochs)
    places: list[Any] = [epoch.source.time.when if timed else epoch.number for epoch in result.epochs]
    for kind, colour in (("missing", "#b2182b"), ("added", "#2166ac")):
        volumes = [sum(region.volume_m3 for region in epoch.regions if region.kind == kind) for epoch in result.epochs]
        variances = [sum(region.volume_std_m3**2 for region in epoch.regions if region.kind == kind) for epoch in result.epochs]
        axes.errorbar(
            places, volumes, NORMAL_95 * np.sqrt(variances), color=colour, marker="o", markersize=3, capsize=2, label=kind
        )
    if timed:
        locator = AutoDateLocator(minticks=2, maxticks=7)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    label_axes(axes, "time (UTC)" if timed else "epoch", "volume against the reference [m³]")
    axes.legend(fontsize=8, frameon=False)
    return png_bytes(figure)


def _law_figure(volumes: list[float], law: PowerLaw) -> bytes:
    ordered = np.sort(volumes)
    figure = Figure(figsize=(5.0, 3.6), dpi=120, layout="constrained")
    axes = figure.subplots()
    axes.loglog(ordered, np.arange(len(ordered), 0, -1), "o", markersize=3, color="0.3", label="rockfalls")
    line = np.geomspace(law.smallest_m3, ordered[-1], 50)
    axes.loglog(line, law.count * (line / law.smallest_m3) ** -law.exponent, color="#b2182b", label=f"V^-{law.exponent:.2f}")
    label_axes(axes, "volume V [m³]", "rockfalls larger than V")
    axes.legend(fontsize=8, frameon=False)
    return png_bytes(figure)

"""Write the folder of a comparison: comparison.json, CSV tables, GeoTIFFs, pictures and report.html."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pipeline.comparison.assess import SensorAssessment, grid_record, shared_scale_m
from pipeline.comparison.comparison import ComparisonResult
from pipeline.comparison.detection_curve import LEAST_BLOCKS, DetectionCurve
from pipeline.comparison.figures import (
    MapPanel,
    covariate_figure,
    detection_figure,
    level_limit_m,
    noise_figure,
    scale_limit_m,
    side_by_side,
    table_figure,
)
from pipeline.comparison.trial import Trial
from pipeline.formats.files.atomic import filling, write_bytes, write_json, write_text
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.report.figures import DIFFERENCE_LABEL
from pipeline.report.map_styles import difference_style, quantity_style
from pipeline.report.page import millimetres, p_value_in_words, percent, template
from pipeline.report.progress import duration
from pipeline.report.provenance import versions
from pipeline.run.clouds import write_cloud
from pipeline.run.recorded_points import recorded_points

COMPARISON_FILE = "comparison.json"
_NOTHING = "\N{EN DASH}"


def write_comparison(out: Path, comparison: ComparisonResult) -> Path:
    """Write all files of a comparison of sensors (maps, tables, pictures, record, report) into a folder.

    The folder `out` appears only when everything is in it. Returns the path of the report.
    """
    with filling(out) as folder:
        _write(folder, comparison)
    return out / "report.html"


def _write(out: Path, comparison: ComparisonResult) -> None:
    """Write all files into a folder."""
    trial, found = comparison.trial, comparison.found
    sizes = _write_products(out, comparison)
    write_csv(out / "noise.csv", _noise_rows(comparison))
    write_csv(out / "by_covariate.csv", _covariate_rows(found))
    write_csv(out / "detection.csv", _class_rows(found))
    write_csv(out / "blocks.csv", ({"sensor": each.name, **b.to_dict()} for each in found for b in each.detection.blocks))
    shown = pictures(comparison)
    for name, png in shown.items():
        write_bytes(out / name, png)
    record = {
        "schema": 1,
        "seed": comparison.config["seed"],
        "epochs": len(trial.epochs),
        "grid": grid_record(trial.grid),
        "sensors": [
            {**each.to_dict(), "angular_step_rad": seen.setup.angular_step_rad, "bytes": sizes[each.name]}
            for each, seen in zip(found, trial.seen, strict=True)
        ],
        "measured": [{"name": maps.name, "points": maps.points, "noise": noise.to_dict()} for maps, noise in comparison.measured],
        "config": comparison.config,
        "versions": versions(),
    }
    write_json(out / COMPARISON_FILE, record)
    page = template("comparison/report.html.jinja").render(
        title="Sensors compared",
        answers=[answer(each) for each in found],
        names=list(comparison.noises()),
        rows=_rows(comparison, sizes),
        pictures=shown,
        epoch=_shown(trial),
        measured=[maps for maps, _ in comparison.measured],
        config=yaml.safe_dump(comparison.config, sort_keys=False, allow_unicode=True),
    )
    write_text(out / "report.html", page)


def answer(found: SensorAssessment) -> str:
    """State as a sentence the smallest block that a sensor detects in 95 % of cases, and from which blocks this was estimated.

    found: the results of the sensor. With too few blocks for an estimate, the sentence says so.
    """
    curve = found.detection.by_size
    if curve is None:
        fell, in_view = len(found.detection.blocks), sum(block.in_view for block in found.detection.blocks)
        return (
            f"{found.name}: {in_view} of the {fell} blocks that fell were in view, too few for a detection curve; "
            f"{LEAST_BLOCKS} are needed."
        )
    blocks = f"{curve.seen} of {curve.count} blocks in view were seen, sizes {_sizes(curve.smallest_m, curve.largest_m)}"
    return f"{found.name}: {_smallest(curve)} ({_interval(*curve.interval_m)}; {blocks})."


def _smallest(curve: DetectionCurve) -> str:
    """Describe the estimate of the smallest block."""
    if curve.smallest_95_m is not None:
        return f"the smallest block seen in 95 % of cases, of those in view, has a size of {_cm(curve.smallest_95_m)}"
    if curve.between_m is None:
        return f"no size is seen in 95 % of cases; {percent(curve.lapse, 0)} of the blocks in view are missed at any size"
    low, high = curve.between_m
    if low is None:
        return f"the smallest block seen in 95 % of cases is smaller than {_cm(curve.smallest_m)}; no such block fell in view"
    if high is None:
        return f"the smallest block seen in 95 % of cases is larger than {_cm(curve.largest_m)}; no such block fell in view"
    return f"the smallest block seen in 95 % of cases lies between {_cm(low)} and {_cm(high)}; no such block fell in view"


def _interval(low_m: float | None, high_m: float | None) -> str:
    """Describe the confidence interval of the smallest block's size; None: the blocks do not bound it."""
    low = "no lower bound" if low_m is None else f"from {_cm(low_m)}"
    high = "no upper bound" if high_m is None else f"to {_cm(high_m)}"
    return f"95 % interval {low} {high}" if low_m is not None and high_m is not None else f"95 % interval: {low}, {high}"


def _sizes(low_m: float, high_m: float) -> str:
    """Format a range of sizes, or one size where both ends read alike."""
    return _cm(low_m) if _cm(low_m) == _cm(high_m) else f"{_cm(low_m)} to {_cm(high_m)}"


def _cm(size_m: float) -> str:
    """Format a length in centimetres."""
    return f"{100 * size_m:.1f} cm"


def summary(comparison: ComparisonResult) -> str:
    """Summarise a comparison for the terminal: for each sensor its angular step, noise, and smallest block detected."""
    steps = [(seen.setup.name, seen.setup.angular_step_rad) for seen in comparison.trial.seen]
    lines = [f"{name}: angular step {_step(step)}" for name, step in steps if step is not None]
    lines += [f"{name}: stable ground {noise.stable.summary()}" for name, noise in comparison.noises().items()]
    return "\n".join(lines + [answer(each) for each in comparison.found])


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a table as a CSV file; without rows, no file is written.

    path: the file. rows: one dictionary for each row. The keys of the first are the header, and None becomes an empty
    cell.
    """
    rows = list(rows)
    if not rows:
        return
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows({key: "" if value is None else value for key, value in row.items()} for row in rows)
    write_text(path, text.getvalue())


def _write_products(out: Path, comparison: ComparisonResult) -> dict[str, dict[str, int]]:
    """Write each sensor's maps, level of detection and reference points; return the file sizes by sensor, bytes."""
    trial, sizes = comparison.trial, {}
    limit = scale_limit_m(shared_scale_m(list(comparison.noises().values())))
    for seen, each in zip(trial.seen, comparison.found, strict=True):
        folder = out / each.name
        for epoch, change in zip(trial.epochs, seen.changes, strict=True):
            path = folder / f"difference_{epoch.number:03d}.tif"
            write_geotiff(path, change, trial.grid, description="reference minus epoch, m; missing rock is positive")
            difference_style(path, limit)
        write_geotiff(folder / "level_of_detection.tif", each.noise.level, trial.grid, description="95 % level of detection, m")
        quantity_style(folder / "level_of_detection.tif", each.noise.level, "mm", 1e3)
        write_cloud(folder / "points.laz", recorded_points(seen.reference.observations))
        sizes[each.name] = {name: (folder / name).stat().st_size for name in ("points.laz", "difference_001.tif")}
    return sizes


def _shown(trial: Trial) -> int:
    """Return the number of the epoch in the pictures: the middle one, of which some blocks are seen and some are missed."""
    return trial.epochs[len(trial.epochs) // 2].number


def pictures(comparison: ComparisonResult) -> dict[str, bytes]:
    """Draw all pictures of the report of a comparison, such as maps and detection curves. Returns PNGs by file name."""
    trial, found, noises = comparison.trial, comparison.found, comparison.noises()
    number = _shown(trial)
    epoch = trial.epochs[number - 1]
    limit = scale_limit_m(shared_scale_m(list(noises.values())))
    maps = [
        MapPanel(f"{each.name}, epoch {number}", seen.changes[number - 1], trial.grid, epoch.block)
        for each, seen in zip(found, trial.seen, strict=True)
    ] + [MapPanel(f"{maps.name} (measured)", maps.maps[0], maps.grid) for maps, _ in comparison.measured]
    grids = [trial.grid] * len(found) + [maps.grid for maps, _ in comparison.measured]
    levels = [MapPanel(name, noise.level, grid) for (name, noise), grid in zip(noises.items(), grids, strict=True)]
    level_limit = level_limit_m(list(noises.values()))
    return {
        "maps.png": side_by_side(maps, limit, DIFFERENCE_LABEL, signed=True),
        "level_of_detection.png": side_by_side(levels, level_limit, "95 % level of detection of a pixel, mm", signed=False),
        "noise.png": noise_figure(noises),
        "by_covariate.png": covariate_figure(found),
        "detection.png": detection_figure(found),
        "size_and_depth.png": table_figure(found),
    }


def _rows(comparison: ComparisonResult, sizes: Mapping[str, Mapping[str, int]]) -> list[tuple[str, list[str]]]:
    """Return the rows of the report's table: a title and one text for each sensor, then for each measurement."""
    noises, found = list(comparison.noises().values()), comparison.found
    blank = [_NOTHING] * len(comparison.measured)

    def simulated(values: Sequence[str]) -> list[str]:
        return [*values, *blank]

    measured_points = [f"{maps.points[0]:,}" if maps.points else _NOTHING for maps, _ in comparison.measured]
    return [
        ("Stable ground: median", [millimetres(each.stable.median) for each in noises]),
        ("Stable ground: StD", [millimetres(each.stable.standard_deviation) for each in noises]),
        ("Stable ground: RMSE", [millimetres(each.stable.rmse) for each in noises]),
        ("Stable ground: NMAD", [millimetres(each.stable.nmad) for each in noises]),
        ("Beyond 3 NMAD (normal: 0.27 %)", [percent(each.tails.beyond_3_nmad, 2) for each in noises]),
        ("Excess kurtosis", [f"{each.tails.excess_kurtosis:.1f}" for each in noises]),
        (
            "Test for a normal distribution on independent pixels: p",
            [p_value_in_words(each.normality.p_value) for each in noises],
        ),
        ("Variogram (StD and range)", [each.model.summary() for each in noises]),
        ("Independent pixels of an epoch", [f"{each.effective:,.0f} of {each.pixels:,}" for each in noises]),
        ("Level of detection of a pixel, 95 %: median", [millimetres(each.median_level_m) for each in noises]),
        ("Whole wall, against the truth: RMSE", simulated([millimetres(each.wall.rmse) for each in found])),
        ("Whole wall, against the truth: NMAD", simulated([millimetres(each.wall.nmad) for each in found])),
        ("Blocks that fell in view", simulated([_share(each, "in_view") for each in found])),
        ("Blocks seen", simulated([_share(each, "seen") for each in found])),
        (
            "Stable ground taken for a block (2.5 % expected)",
            simulated([f"{each.detection.alarms} of {each.detection.trials:,}" for each in found]),
        ),
        ("Wall that the sensor can see", simulated([percent(each.visible) for each in found])),
        ("Hidden (occlusion)", simulated([percent(1 - each.visible) for each in found])),
        ("Wall with data (completeness)", simulated([percent(each.complete) for each in found])),
        ("Visible wall with data", simulated([percent(each.complete_of_visible) for each in found])),
        ("Hidden wall with data (bridged by triangles)", simulated([percent(each.complete_of_hidden) for each in found])),
        (
            "Angular step, azimuth by zenith",
            simulated([_step(seen.setup.angular_step_rad) for seen in comparison.trial.seen]),
        ),
        ("Points of the reference", [f"{each.points:,}" for each in found] + measured_points),
        ("Time to measure", simulated([_seconds(each.scan_seconds) for each in found])),
        ("Time to simulate an epoch", simulated([_seconds(each.seconds) for each in found])),
        ("Size of points.laz", simulated([_megabytes(sizes[each.name]["points.laz"]) for each in found])),
        ("Size of a difference map", simulated([_megabytes(sizes[each.name]["difference_001.tif"]) for each in found])),
        (
            "Registration: RMS of the inliers",
            simulated([millimetres(each.registration_rms_m) for each in found]),
        ),
    ]


def _step(step_rad: tuple[float, float] | None) -> str:
    """Format angular steps in mrad."""
    return _NOTHING if step_rad is None else " by ".join(f"{1e3 * step:.3g}" for step in step_rad) + " mrad"


def _share(found: SensorAssessment, field: str) -> str:
    """Count the blocks for which a field is true, of all blocks."""
    return f"{sum(getattr(block, field) for block in found.detection.blocks)} of {len(found.detection.blocks)}"


def _noise_rows(comparison: ComparisonResult) -> Iterable[dict[str, Any]]:
    """Yield the rows of noise.csv."""
    for name, noise in comparison.noises().items():
        for number, each in enumerate([noise.stable, *noise.per_epoch]):
            yield {
                "sensor": name,
                "epoch": number or "all",
                **each.to_dict(),
                **(noise.tails.to_dict() if number == 0 else dict.fromkeys(noise.tails.to_dict())),
                "sill_m2": noise.model.sill_m2,
                "effective_sample_size": noise.effective,
            }


def _covariate_rows(found: Sequence[SensorAssessment]) -> Iterable[dict[str, Any]]:
    """Yield the rows of by_covariate.csv."""
    for each in found:
        for name, bins in each.by.items():
            yield from ({"sensor": each.name, "covariate": name, **item.to_dict()} for item in bins)


def _class_rows(found: Sequence[SensorAssessment]) -> Iterable[dict[str, Any]]:
    """Yield the rows of detection.csv."""
    for each in found:
        for name, classes in (("size", each.detection.size_classes), ("depth", each.detection.depth_classes)):
            yield from ({"sensor": each.name, "by": name, **item.to_dict()} for item in classes)


def _seconds(seconds: float | None) -> str:
    """Format a duration."""
    if seconds is None:
        return _NOTHING
    return f"{seconds:.2g} s" if seconds < 10 else duration(seconds)


def _megabytes(size: int) -> str:
    """Format a file size."""
    return f"{size / 1e6:.1f} MB"

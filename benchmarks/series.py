"""What `scarpsim monitor` finds in a simulated series, how well `inspect --series` promised it, and what a series costs.

    python benchmarks/series.py [--parts found speed] [--write]         with --write into docs/validation/series.md

A series of the config below is simulated, monitored as a user would, and compared with its truth, series.json. A rockfall counts
if the sensor sees at least half of its volume. The last part compares the processor time of a series with that of its bare ray
casts and booleans.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from documents import printed, write_between

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pipeline.config.simulation import SimulationConfig  # noqa: E402
from pipeline.monitoring.options import MonitorOptions  # noqa: E402
from pipeline.monitoring.products import Result  # noqa: E402
from pipeline.monitoring.run import monitor_paths  # noqa: E402
from pipeline.planning.series import SeriesPlan, plan_series  # noqa: E402
from pipeline.report.progress import Progress  # noqa: E402
from pipeline.run.epoch import observe_reference  # noqa: E402
from pipeline.run.series import Series, observe_series_epoch  # noqa: E402
from pipeline.run.simulation import simulate  # noqa: E402
from pipeline.run.site import prepare_site  # noqa: E402
from scene.blocks.solid import close_patch, solid_of, split_wall  # noqa: E402
from scene.common.backend import dr  # noqa: E402
from scene.common.config import parse  # noqa: E402
from scene.common.keyed_random import KeyedRandom  # noqa: E402
from scene.geometry.frame import WallFrame  # noqa: E402
from scene.geometry.under_boxes import faces_under_boxes  # noqa: E402
from scene.ray_casting.raycast import RayCaster  # noqa: E402
from sensors.laser.tls import LaserScanner  # noqa: E402

DOCUMENT = ROOT / "docs" / "validation" / "series.md"
MARKS = {name: (f"<!-- {name} -->", f"<!-- end of {name} -->") for name in ("found", "promised", "leads", "speed")}
CLASSES_L = ((0.3, 1.0), (1.0, 3.0), (3.0, 10.0), (10.0, np.inf))
CONFIG: dict[str, Any] = {
    "seed": 11,
    "wall": {"style": "glendale", "width_m": 16.0, "height_m": 10.0, "resolution_m": 0.04, "seed": 7},
    "station": {"distance_m": 40.0},
    "scanner": {"azimuth_step_rad": 0.0007, "zenith_step_rad": 0.0007},
    "difference": {"gsd_m": 0.03},
    "products": {"truth": False, "surface": False},
    "rockfall": {"minimum_distance_m": 0.2},
    "series": {
        "times": {"start": "2026-03-01T00:00:00Z", "every_h": 1, "count": 37},
        "rockfall": {"rate_per_day": 50, "volume_m3": {"power_law": {"exponent": 0.5, "smallest": 0.0005, "largest": 0.1}}},
        "precursor": {"share": 0.4, "lead_h": 24, "displacement_m": 0.03},
        "deposits": {"fragments": 5},
        "conditions": {
            "pose": {"position_m": {"random_walk": 0.002}, "rotation_rad": {"random_walk": 0.00002}},
            "effects": {"range_scale": {"cycle": {"amplitude": 5, "largest_after_h": 14}}},
        },
    },
}
LARGE: dict[str, Any] = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 52.0, "height_m": 31.0, "resolution_m": 0.05, "seed": 1},
    "station": {"distance_m": 60.0},
    "scanner": {"azimuth_step_rad": 0.00065, "zenith_step_rad": 0.00055},
    "difference": {"gsd_m": 0.05},
    "series": {"times": {"start": "2026-03-01", "every_h": 1, "count": 101}, "rockfall": {"rate_per_day": 24}, "deposits": True},
}
"""A wall of 1.3 million triangles and a million pulses."""
OVERLAP = 0.3
APART_M = 0.1
"""Distance between bounding boxes up to which an earlier change may be one event with a rockfall, three pixels of the map."""
NORMAL_95 = 1.96


@dataclass(frozen=True)
class Outcome:
    """A rockfall beside what was found of it.

    volume: m3; seen: share of the volume in the map; kept: whether it is listed in the first epoch without it; late: epochs from
    that epoch to the first that lists it, NaN: none; measured, sigma: volume with its standard deviation there, m3; lead: hours
    before the fall at which it is listed as a block that moved out, NaN: not, or it did not move; untouched: whether nothing had
    fallen, moved or come to rest within `APART_M` of it.
    """

    volume: float
    seen: float
    late: float
    measured: float
    sigma: float
    moved: bool
    lead: float
    untouched: bool


def found(folder: Path, config: SimulationConfig) -> tuple[list[Outcome], list[tuple[bool, str]], dict[str, Any]]:
    """Simulate and monitor the series; returns its rockfalls, the false events (marked or not, kind), and its truth."""
    run = folder / "run"
    simulate(config, "tls", run)
    result = monitor_paths([run], folder / "found", MonitorOptions())
    truth = json.loads((run / "series.json").read_text(encoding="utf-8"))
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    frame = WallFrame(np.array(record["wall_frame"]["rotation"]), np.array(record["wall_frame"]["origin_m"]))
    hits: dict[tuple[int, str], dict[int, tuple[float, float]]] = {}
    false: dict[int, tuple[bool, str]] = {}
    known: set[int] = set()
    for epoch in result.epochs:
        hour = truth["hours"][epoch.number]
        for region in epoch.regions:
            box = _box(region, result, frame)
            number = _event_at(box, region.kind, hour, truth["events"])
            if number is None and region.identity not in known:
                false[region.identity] = bool(region.marks), region.kind
            known.add(region.identity)
            if number is not None:
                held = hits.setdefault((number, region.kind), {})
                volume, variance = held.get(epoch.number, (0.0, 0.0))
                held[epoch.number] = volume + region.volume_m3, variance + region.volume_std_m3**2
    outcomes = [_outcome(event, record["epochs"], truth, hits) for event in truth["events"]]
    return [each for each in outcomes if each is not None], list(false.values()), truth


def _box(region: Any, result: Result, frame: WallFrame) -> np.ndarray:
    """Rectangle (2, 2) of a region, in the run's wall frame, m."""
    view = result.site.views[region.view - 1]
    centre = frame.to_wall(view.frame.to_world(np.array([region.x_m, region.y_m, region.z_m])))[:2]
    half = np.array([region.width_m, region.height_m]) / 2
    return np.stack([centre - half, centre + half])


def _event_at(box: np.ndarray, kind: str, hour: float, events: Sequence[dict[str, Any]]) -> int | None:
    """Number of the rockfall that a region shows at a time; deposits count as 0."""
    best, share = None, OVERLAP
    for event in events:
        fallen = event["falls_h"] <= hour
        if fallen == (kind == "missing") and (fallen or event["precursor"]):
            shared = _overlap(box, _rectangle(event["block"]["bbox_m"]))
            best, share = (event["event"], shared) if shared > share else (best, share)
    if best is None and kind == "added":
        lying = [_rectangle(event["deposit_bbox_m"]) for event in events if event["deposit_bbox_m"]]
        best = 0 if any(_overlap(box, each) > OVERLAP for each in lying) else None
    return best


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Area that two rectangles (2, 2) share, over that of the smaller one."""
    sides = np.clip(np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]), 0, None)
    return float(sides.prod() / max(min(np.prod(one[1] - one[0]), np.prod(other[1] - other[0])), 1e-12))


def _outcome(
    event: dict[str, Any],
    epochs: Sequence[dict[str, Any]],
    truth: dict[str, Any],
    hits: dict[tuple[int, str], dict[int, tuple[float, float]]],
) -> Outcome | None:
    """What was found of a rockfall; None for one that falls after the series."""
    first, number, hours = event["first_missing_epoch"], event["event"], truth["hours"]
    if first is None:
        return None
    block = next(each for each in epochs[first]["blocks"] if each["label"] == number)
    seen = float(block["measured_volume_m3"] or 0.0) / event["volume_m3"]
    listed = {epoch: each for epoch, each in hits.get((number, "missing"), {}).items() if epoch >= first}
    at = min(listed, default=None)
    volume, variance = (np.nan, np.nan) if at is None else listed[at]
    early = [epoch for epoch in hits.get((number, "added"), {}) if epoch < first]
    lead = event["falls_h"] - hours[min(early)] if early else np.nan
    late = np.nan if at is None else float(at - first)
    moved, untouched = event["precursor"] is not None, _is_untouched(event, truth)
    return Outcome(event["volume_m3"], seen, late, volume, float(np.sqrt(variance)), moved, lead, untouched)


def _is_untouched(event: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether nothing had changed beside a rockfall in the first epoch without it."""
    hour = truth["hours"][event["first_missing_epoch"]]
    around = _rectangle(event["block"]["bbox_m"]) + APART_M * np.array([[-1.0], [1.0]])
    for other in truth["events"]:
        if other["event"] == event["event"]:
            continue
        fallen = other["falls_h"] <= hour
        changed = [other["block"]["bbox_m"]] if fallen or other["precursor"] else []
        changed += [other["deposit_bbox_m"]] if fallen and other["deposit_bbox_m"] else []
        if any(_overlap(around, _rectangle(each)) > 0 for each in changed):
            return False
    return True


def _rectangle(box: Sequence[float]) -> np.ndarray:
    """(2, 2) lower and upper corner of a bounding box in the plane of the wall, m."""
    return np.array(box).reshape(2, 3)[:, :2]


def found_rows(outcomes: Sequence[Outcome], false: Sequence[tuple[bool, str]], days: float) -> Iterator[str]:
    """Rows of the table of what was found."""
    yield "| volume | found | in the first epoch | volume, bias | 95 % intervals that hold the true volume |"
    yield "|---|---|---|---|---|"
    for low, high in CLASSES_L:
        inside = [each for each in outcomes if low <= 1e3 * each.volume < high and each.seen >= 0.5]
        hit = [each for each in inside if np.isfinite(each.late)]
        bias = f"{100 * float(np.median([each.measured / each.volume - 1 for each in hit])):+.1f} %" if hit else "-"
        held = sum(abs(each.measured - each.volume) < NORMAL_95 * each.sigma for each in hit)
        name = f"{low:g} to {high:g} l" if np.isfinite(high) else f"above {low:g} l"
        first = sum(each.late == 0 for each in hit)
        yield f"| {name} | {len(hit)} of {len(inside)} | {first} | {bias} | {held} of {len(hit)} |"
    unmarked = [kind for marked, kind in false if not marked]
    yield ""
    yield (
        f"False events: {len(false) / days:.1f} a day, of which {len(unmarked) / days:.1f} have no mark "
        f"({unmarked.count('missing')} missing and {unmarked.count('added')} added in {days:g} days)."
    )


def promised_rows(outcomes: Sequence[Outcome], plan: SeriesPlan) -> Iterator[str]:
    """Rows of the table of promised and found shares."""
    yield "| volume | place | rockfalls | promised to be listed | listed in the first epoch | difference in standard deviations |"
    yield "|---|---|---|---|---|---|"
    law = plan.promises[0].missing
    for low, high in CLASSES_L:
        for untouched in (True, False):
            inside = [
                each for each in outcomes if low <= 1e3 * each.volume < high and each.seen >= 0.5 and each.untouched == untouched
            ]
            if not inside:
                continue
            share = law.probability(np.array([each.volume for each in inside]))
            hit = sum(each.late == 0 for each in inside)
            spread = float(np.sqrt(max(np.sum(share * (1 - share)), 0.25)))
            name = f"{low:g} to {high:g} l" if np.isfinite(high) else f"above {low:g} l"
            place = "untouched rock" if untouched else "beside an earlier change"
            difference = f"{(hit - share.sum()) / spread:+.1f}"
            yield f"| {name} | {place} | {len(inside)} | {share.sum():.1f} | {hit} | {difference} |"
    value, lower, upper = law.volume_m3()
    yield ""
    yield f"Promised smallest rockfall (95 %): {1e3 * value:.2g} l, interval {1e3 * lower:.2g} to {1e3 * upper:.2g} l."


def lead_rows(outcomes: Sequence[Outcome], plan: SeriesPlan) -> Iterator[str]:
    """Rows of the table of lead times."""
    heads = "promised lead, 95 % | reached by | median lead: promised, found"
    yield f"| volume | blocks that moved | listed before the fall | {heads} |"
    yield "|---|---|---|---|---|---|"
    promise, every = plan.promises[0], plan.every_h or 1.0
    for low, high in CLASSES_L:
        inside = [each for each in outcomes if low <= 1e3 * each.volume < high and each.moved and each.seen >= 0.5]
        if not inside:
            continue
        leads = np.array([0.0 if np.isnan(each.lead) else each.lead for each in inside])
        least, usual = np.array([plan.lead_h(each.volume, every, promise) for each in inside]).T
        name = f"{low:g} to {high:g} l" if np.isfinite(high) else f"above {low:g} l"
        yield (
            f"| {name} | {len(inside)} | {int((leads > 0).sum())} | {least.min():.1f} to {least.max():.1f} h | "
            f"{int((leads >= least).sum())} of {len(inside)} | {np.median(usual):.1f} h, {np.median(leads):.1f} h |"
        )


def speed(epochs: int) -> Iterator[str]:
    """Rows of the table of processor time."""
    config = parse(SimulationConfig, LARGE, "benchmark")
    random, progress = KeyedRandom(config.seed), Progress()
    site = prepare_site(config, "tls", random)
    series = Series.of(config, config.series, site, random)  # type: ignore[arg-type]
    reference = observe_reference(config, series.site_at(0), random, progress)
    scenes, before, total, bare, peaks = series.scenes(), reference.raster.heights, [], [], []
    for _ in range(epochs):
        began = time.process_time()
        scene = next(scenes)
        found = observe_series_epoch(series, reference, scene, before, progress)
        before = found.raster.heights
        total.append(time.process_time() - began)
        bare.append(_bare(site, scene.scene))
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
    yield "| epochs | triangles | pulses | an epoch of the series | bare casts and booleans | ratio | memory: first, last epoch |"
    yield "|---|---|---|---|---|---|---|"
    pulses = site.sensor.pattern.lines * site.sensor.pattern.pulses if isinstance(site.sensor, LaserScanner) else 0
    own, least = float(np.median(total)), float(np.median(bare))
    yield (
        f"| {epochs} | {len(site.mesh.faces):,} | {pulses:,} | {own:.1f} s | {least:.1f} s | {own / least:.1f} | "
        f"{peaks[0]:.1f} GB, {peaks[-1]:.1f} GB |"
    )


def _bare(site: Any, scene: Any) -> float:
    """Processor time of one boolean of the epoch's blocks, and of casting all pulses once, s."""
    began = time.process_time()
    if len(scene.solids):
        blocks = scene.solids
        rows = faces_under_boxes(site.mesh, blocks.bbox)
        wall, _ = close_patch(site.mesh, rows, float(blocks.bbox[:, 0, 2].min()))
        split_wall(wall, solid_of(blocks.vertices, blocks.faces, "blocks"))
    caster = RayCaster(scene.carved.mesh)
    pulses, beam = site.sensor.emitted(site.sensor.emit(), KeyedRandom(0))
    dr.eval(site.sensor.echo(caster, pulses, beam, beam.combine_echoes))
    dr.sync_thread()
    return time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=["found", "speed"], choices=["found", "speed"])
    parser.add_argument("--speed-epochs", type=int, default=100, help="epochs of the part `speed`")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/validation/series.md")
    arguments = parser.parse_args()
    tables: dict[str, str] = {}
    if "found" in arguments.parts:
        config = parse(SimulationConfig, CONFIG, "benchmark")
        with tempfile.TemporaryDirectory() as folder:
            outcomes, false, truth = found(Path(folder), config)
        plan = plan_series(config, "tls")
        tables["found"] = printed(found_rows(outcomes, false, truth["hours"][-1] / 24))
        tables["promised"] = printed(promised_rows(outcomes, plan))
        tables["leads"] = printed(lead_rows(outcomes, plan))
    if "speed" in arguments.parts:
        tables["speed"] = printed(speed(arguments.speed_epochs))
    for name, table in tables.items() if arguments.write else ():
        write_between(DOCUMENT, MARKS[name], table)


if __name__ == "__main__":
    main()

"""Scene changes found by `pipeline.gap.residuals.scene_changes`: each is listed once with box and volume; none on quiet walls.

The volume of a block of n points is known to 20 % (because its sides are partly seen, obliquely) plus 1.6 / sqrt(n) (because of
which points lie on it).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from change_cases import SIGMA, Array, Box, Scan, draw_boxes, noise, scan
from gap_cases import STEP, smooth_noise, write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.report.report import summarise, to_dict
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.residuals.scene_changes import SceneChange, find_scene_changes
from pipeline.gap.residuals.sensor_view import SensorView
from pipeline.gap.residuals.tls_residuals import TlsResiduals

STEPS = [4e-3, 2e-3, 1e-3]
"""20,000, 80,000 and 325,000 points."""


def found_in(seen: Scan, value: Array, epoch: Any = None) -> list[SceneChange]:
    n, one = len(value), np.ones(len(value))
    at = (seen.plane[:, None] * seen.ray)[:, [0, 2]]
    covariates = {"azimuth": seen.azimuth, "zenith": seen.zenith, "range": seen.plane}
    true = np.ones(n, dtype=bool)
    geometry = RayGeometry(seen.azimuth, seen.zenith)
    residuals = TlsResiduals(value, SIGMA * one, one, true, true, np.zeros((n, 6)), at, covariates, np.arange(n), geometry)
    plane = np.stack([seen.azimuth, seen.zenith], axis=1)
    sight = SensorView(plane, np.zeros(n, dtype=int) if epoch is None else epoch, np.zeros((n, 3)), seen.ray, seen.plane)
    return find_scene_changes(residuals, sight, true)[0]


def touches(box: Box, change: SceneChange) -> bool:
    low, high = np.maximum(box.bounds[0], change.bounds[0]), np.minimum(box.bounds[1], change.bounds[1])
    return bool((low < high).all())


def check(seen: Scan, boxes: list[Box], found: list[SceneChange]) -> None:
    """Assert that each clear block is exactly one change, and that each change is on one block.

    A clear block has at least five points and five sigmas.
    """
    owners = np.array([[touches(box, change) for change in found] for box in boxes]).reshape(len(boxes), len(found))
    assert (owners.sum(axis=0) == 1).all()
    for box, hits, row in zip(boxes, seen.hits, owners, strict=True):
        if len(hits) < 5 or np.abs(seen.clean[hits]).mean() < 5 * SIGMA:
            continue
        assert row.sum() == 1
        change = found[int(np.argmax(row))]
        assert np.sign(change.offset_m) == np.sign(box.depth)
        assert change.volume_m3 == pytest.approx(box.volume, rel=0.2 + 1.6 / np.sqrt(len(hits)))


@pytest.mark.parametrize("step_rad", STEPS)
def test_small_blocks_are_found_once_each(step_rad: float) -> None:
    """Ten blocks of 0.1 to 0.3 m with about five to fifty points each, among 1 % of outliers and with 2 % of returns lost."""
    rng = np.random.default_rng(1)
    spacing = 30 * step_rad
    boxes = draw_boxes(10, (1.1 * spacing, 3.4 * spacing), (0.1, 0.3), rng)
    seen = scan(step_rad, boxes, 0.02, rng)
    check(seen, boxes, found_in(seen, seen.clean + noise(seen, 0.01, 0.0004, rng)))


@pytest.mark.parametrize("step_rad", STEPS)
def test_blocks_of_five_sigmas_are_found(step_rad: float) -> None:
    rng = np.random.default_rng(2)
    spacing = 30 * step_rad
    boxes = draw_boxes(10, (1.6 * spacing, 4.0 * spacing), (5.2 * SIGMA, 6.0 * SIGMA), rng)
    seen = scan(step_rad, boxes, 0.02, rng)
    check(seen, boxes, found_in(seen, seen.clean + noise(seen, 0.005, 0.0004, rng)))


@pytest.mark.parametrize("step_rad", STEPS)
def test_a_large_block_stays_whole(step_rad: float) -> None:
    """Five blocks of up to 1.8 m, with 4,000 points in the densest scan."""
    rng = np.random.default_rng(3)
    boxes = draw_boxes(5, (0.3, 0.9), (0.1, 0.4), rng)
    seen = scan(step_rad, boxes, 0.02, rng)
    check(seen, boxes, found_in(seen, seen.clean + noise(seen, 0.01, 0.0004, rng)))


@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_blocks_some_points_apart_are_not_merged(stretch: float) -> None:
    """Blocks with four points of wall between them are separate changes.

    The raster may be three times as wide in one direction as in the other.
    """
    step = 2e-3
    spacing = 30 * step
    boxes = [Box(side * (0.3 + 2.5 * spacing * stretch), 0.1, (0.3, 0.3), 0.2) for side in (-1, 1)]
    seen = scan(step, boxes, 0.02, np.random.default_rng(4), stretch)
    check(seen, boxes, found_in(seen, seen.clean + noise(seen, 0.01, 0.0004, np.random.default_rng(5))))


def test_a_change_in_two_epochs_is_one() -> None:
    rng = np.random.default_rng(6)
    boxes = [Box(1.0, -2.0, (0.4, 0.3), 0.2), Box(-3.0, 1.0, (0.25, 0.25), -0.15)]
    once = scan(3e-3, boxes, 0.0, rng)
    value = np.concatenate([once.clean + noise(once, 0.01, 0.0004, rng) for _ in range(2)])
    columns = (once.azimuth, once.zenith, once.ray, once.plane, once.clean)
    twice = Scan(*(np.concatenate([each, each]) for each in columns), once.hits)
    check(once, boxes, found_in(twice, value, np.repeat([0, 1], len(once.plane))))


@pytest.mark.parametrize("walls", [5, 20])
@pytest.mark.parametrize("outliers", [0.0, 0.02])
def test_nothing_is_found_on_a_quiet_wall(outliers: float, walls: int) -> None:
    """No change is found on a wall without changes.

    By construction, false changes number at most 0.01 per wall by points and 0.01 by medians: at most a tenth of other seeds
    fail on 5 walls, a third on 20.
    """
    for seed in range(walls):
        rng = np.random.default_rng(seed)
        seen = scan(4e-3, [], 0.02, rng)
        assert found_in(seen, noise(seen, outliers, 0.0006, rng)) == []


def test_nothing_is_found_on_a_wall_whose_reference_is_wrong_by_more_than_the_noise() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen = scan(4e-3, [], 0.02, rng)
        assert found_in(seen, noise(seen, 0.01, 0.005, rng)) == []


def test_nine_small_rockfalls_of_a_whole_scan(tmp_path: Path) -> None:
    """Nine rockfalls of five to eight points are found in a whole scan.

    They are pyramids over one node of the wall, of 90 to 200 mm, which the reference lacks.
    """
    nodes = [(25, 20), (35, 60), (45, 35), (55, 15), (60, 50), (70, 70), (75, 30), (95, 20), (100, 60)]
    blocks = [(i, j, 0.24 + 0.02 * number) for number, (i, j) in enumerate(nodes)]
    write_scan(tmp_path, 9, blocks=blocks, step_rad=0.006)
    measurement = read_measurement(tmp_path)
    found = diagnose(measurement)
    assert found.verdict == "no_gap"
    changes = to_dict(found, measurement)["scene_changes"]
    boxes = np.array([change["bbox_m"] for change in changes])
    assert len(boxes) == len(blocks)
    for i, j, depth in blocks:
        inside = (boxes[:, 0] < i * STEP) & (i * STEP < boxes[:, 3]) & (boxes[:, 2] < j * STEP) & (j * STEP < boxes[:, 5])
        assert inside.sum() == 1
        assert changes[int(np.argmax(inside))]["volume_m3"] == pytest.approx(depth * STEP**2, rel=0.35)


@pytest.mark.parametrize("seed", [9, 13])
def test_where_much_of_the_wall_moved_nothing_is_said_of_the_sensor(tmp_path: Path, seed: int) -> None:
    """Every third node of the wall fell by 0.1 to 0.4 m, in clumps: the answer asks for stable areas."""
    rng = np.random.default_rng(12)
    clumps = smooth_noise((121, 86), 4.0, rng)
    fallen = [(int(i), int(j), 0.15 + 0.2 * rng.uniform()) for i, j in np.argwhere(clumps > 0.35)]
    write_scan(tmp_path, seed, blocks=fallen, step_rad=0.009)
    found = diagnose(read_measurement(tmp_path))
    assert found.verdict == "insufficient_data"
    assert found.evidence.moved_share > 0.3
    assert found.effects == ()
    assert found.remaining["note"].index("add stable_areas") < 400
    assert "stable_areas in measurement.yaml" in summarise(found)


@pytest.mark.parametrize(("half", "depth", "reference"), [((0.1, 0.4), (0.02, 0.05), 1e-3), ((0.3, 0.9), (0.1, 0.4), 4e-4)])
def test_volumes_are_known_as_well_as_is_said(half: Any, depth: Any, reference: float) -> None:
    """The errors of 48 volumes agree with their stated standard deviations.

    The ratios have a root mean square of 0.6 to 1.25; chance changes it by 0.1.
    """
    off = []
    for seed in range(8):
        rng = np.random.default_rng(200 + seed)
        boxes = draw_boxes(6, half, depth, rng)
        seen = scan(3e-3, boxes, 0.02, rng)
        for change in found_in(seen, seen.clean + noise(seen, 0.01, reference, rng)):
            owner = [box for box in boxes if touches(box, change)]
            off.append((change.volume_m3 - owner[0].volume) / change.volume_std_m3)
    assert len(off) > 40
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.25


def test_a_large_noise_is_no_wall_that_moved(tmp_path: Path) -> None:
    """Noise that is much larger than the model's does not pass for a moved wall.

    The noise is 8 cm where the model has 3 mm, so on half of the wall medians of nine points are off by more than three predicted
    sigmas and 2 cm.
    """
    write_scan(tmp_path, 9, ranges=lambda scan: scan.R + 0.08 * scan.rng.standard_normal(len(scan.R)), step_rad=0.009)
    found = diagnose(read_measurement(tmp_path))
    assert "tls.range_noise" in {name for effect in found.effects for name in (effect.name, *effect.indistinguishable)}
    assert not found.evidence.much_moved

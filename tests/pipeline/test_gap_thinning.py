"""Scans with more points than are used: which points are drawn, lost pulses are drawn as often, and the answer is the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gap_cases import Array, write_scan

from pipeline.formats.measurements.measurement import TlsMeasurement, read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.gap.residuals.subsampling import subsample_measurement
from pipeline.gap.residuals.tls_residuals import find_expected_pulses, tls_residuals, with_scan_order
from pipeline.gap.thresholds import Thresholds, use_thresholds
from scene.common.keyed_random import KeyedRandom

_MOST = 6_000


def _few() -> Thresholds:
    usual = Thresholds()
    return usual.model_copy(update={"points": usual.points.model_copy(update={"most": _MOST})})


def _scan(folder: Path) -> TlsMeasurement:
    def wobble(azimuth: Array, zenith: Array, line: Array) -> tuple[Array, Array]:
        return np.zeros_like(azimuth), 3e-4 * np.sin(2 * np.pi * line / 37.0)

    write_scan(folder, 3, angles=wobble, lost=lambda scan: scan.rng.uniform(size=len(scan.power)) < 0.1)
    found = read_measurement(folder)
    assert isinstance(found, TlsMeasurement)
    return with_scan_order(found)


def test_points_are_drawn_alike_all_over_the_scan_and_lost_pulses_as_often(tmp_path: Path) -> None:
    """Within 4 standard errors: the number drawn, the share of either half of the lines, and the share of lost pulses."""
    scan = _scan(tmp_path)
    share = _MOST / len(scan.cloud.points)
    with use_thresholds(_few()):
        part, rows = subsample_measurement(scan, KeyedRandom(1))
        again, others = (subsample_measurement(scan, KeyedRandom(seed))[1] for seed in (1, 2))
    assert isinstance(part, TlsMeasurement)
    np.testing.assert_array_equal(part.cloud.points, scan.cloud.points[rows])
    assert scan.order is not None
    assert part.order is not None
    np.testing.assert_array_equal(np.asarray(part.order[0]), np.asarray(scan.order[0])[rows])
    np.testing.assert_array_equal(rows, again)
    assert not np.array_equal(rows[:100], others[:100])
    assert len(rows) == pytest.approx(_MOST, abs=4 * np.sqrt(_MOST))
    first = float(np.mean(rows < len(scan.cloud.points) / 2))
    assert first == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(_MOST))
    whole, drawn = find_expected_pulses(scan, tls_residuals(scan)), find_expected_pulses(part, tls_residuals(part))
    assert whole is not None
    assert drawn is not None
    assert len(drawn.lost) == pytest.approx(share * len(whole.lost), abs=4 * np.sqrt(share * len(whole.lost)))
    lost = whole.lost.mean()
    assert 0.05 < lost < 0.2
    assert drawn.lost.mean() == pytest.approx(lost, abs=4 * np.sqrt(lost * (1 - lost) / len(drawn.lost)))
    assert any(f"{len(rows):,} of {len(scan.cloud.points):,} points" in note for note in part.notes)


def test_a_part_of_the_points_names_the_same(tmp_path: Path) -> None:
    """From a sixth of the points the wobble is named, and the answer's rows refer to the whole scan."""
    scan = _scan(tmp_path)
    found = diagnose(scan, thresholds=_few())
    assert [each.name for each in found.effects][:1] == ["tls.wobble"]
    assert len(found.before) < 1.1 * _MOST
    assert found.residuals.index.max() > 0.9 * len(scan.cloud.points)
    assert f"of {len(scan.cloud.points):,} points" in found.remaining["note"]


def test_fewer_points_than_the_bound_are_all_looked_at(tmp_path: Path) -> None:
    scan = _scan(tmp_path)
    part, rows = subsample_measurement(scan, KeyedRandom(1))
    assert part is scan
    np.testing.assert_array_equal(rows, np.arange(len(scan.cloud.points)))

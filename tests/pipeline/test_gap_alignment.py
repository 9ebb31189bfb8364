"""The pose of a large measurement is estimated from a part of its points, before that of all of them."""

from __future__ import annotations

import numpy as np
import pytest
from gap_cases import write_scan

from benchmarks.gap_closed_form.cases import Case, make
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, read_measurement
from pipeline.gap.residuals import alignment
from pipeline.gap.residuals.alignment import align
from sensors.effects.smoothing import Smoothing

MOVE = np.array([0.03, -0.02, 0.04, 2e-4, -3e-4, 1e-4])
"""Shift, m, and rotation, rad, from the true pose: ten times as far as a pose may be off without new residuals."""


@pytest.fixture(scope="module", params=["tls", "stereo"])
def moved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Measurement:
    """Some ten thousand points of a sensor that does not stand where it should."""
    folder = tmp_path_factory.mktemp("moved")
    if request.param == "tls":
        write_scan(folder, 1)
        return read_measurement(folder).moved(MOVE)
    make(Case(0, (5, 1), "none", "stereo", (), 12_000, 12_000), folder / "case", folder / "truth.json", baselines=False)
    pair = read_measurement(folder / "case")
    assert isinstance(pair, StereoMeasurement)
    noise = pair.model.noise.model_copy(update={"parallax_sigma_px": 5 * pair.model.noise.parallax_sigma_px})
    return pair.changed(model=pair.model.model_copy(update={"noise": noise})).moved(
        MOVE
        # with a larger predicted noise, the pose of few points is precise enough
    )


def traced(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Record how many points each computation of residuals has, in the list that is returned."""
    counts, plain = [], alignment.compute_residuals

    def counted(measurement: Measurement) -> alignment.Residuals:
        counts.append(len(measurement.cloud.points))
        return plain(measurement)

    monkeypatch.setattr(alignment, "compute_residuals", counted)
    return counts


def test_residuals_of_all_points_are_computed_once(moved: Measurement, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pose from a part of the points differs from that of all by no more than the noise of the part lets expect.

    Without the part, they are computed before and after the move. A pose of six values from m points moves the predictions by
    sqrt(6 / m) standard deviations (root mean square); four times this is allowed.
    """
    count, counts = len(moved.cloud.points), traced(monkeypatch)
    whole = align(moved)
    assert counts.count(count) > 1
    counts.clear()
    monkeypatch.setattr(alignment, "_MANY", count)
    monkeypatch.setattr(alignment, "_PART", count // 3)
    some = align(moved)
    assert counts.count(count) == 1
    assert len(counts) > 2, "the part is traced again as well"
    apart = some.residuals.pose_jacobian @ (some.pose - whole.pose) / some.residuals.sigma
    assert np.sqrt(np.mean(apart**2)) < 4 * np.sqrt(6 / (count / 3))
    trusted = np.arange(0, count, 2)
    half = align(moved, trusted)
    apart = half.residuals.pose_jacobian @ (half.pose - whole.pose) / half.residuals.sigma
    assert np.sqrt(np.mean(apart**2)) < 4 * np.sqrt(6 / (count / 3))


@pytest.mark.parametrize("moved", ["stereo"], indirect=True)
def test_effects_of_neighbouring_pixels_need_all_points(moved: StereoMeasurement, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = traced(monkeypatch)
    monkeypatch.setattr(alignment, "_MANY", 1)
    align(moved.changed(model=moved.model.model_copy(update={"effects": (Smoothing(sigma_px=2.0),)})))
    assert set(counts) == {len(moved.cloud.points)}

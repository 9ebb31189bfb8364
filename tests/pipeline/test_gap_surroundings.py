"""The surroundings of the places that pixels see, which are cast once and reused."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.gap_closed_form.cases import Case, make
from pipeline.formats.measurements.measurement import StereoMeasurement, read_measurement
from pipeline.formats.measurements.surroundings import Surroundings
from pipeline.gap.residuals.stereo_residuals import stereo_residuals, with_surroundings
from scene.common.backend import dr, mi
from scene.ray_casting.raycast import Hits, RayCaster


@pytest.fixture(scope="module")
def measurement(tmp_path_factory: pytest.TempPathFactory) -> StereoMeasurement:
    folder = tmp_path_factory.mktemp("surroundings")
    make(Case(0, (8, 1), "none", "stereo", (), 8_000, 8_000), folder / "case", folder / "truth.json", baselines=False)
    read = read_measurement(folder / "case")
    assert isinstance(read, StereoMeasurement)
    return read


def _casts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Collect the rays of each cast from here on."""
    counts: list[int] = []
    intersect = RayCaster.intersect

    def counted(self: RayCaster, origin: mi.Array3f64, direction: mi.Array3f64, **options: bool) -> Hits:
        counts.append(dr.width(direction))
        return intersect(self, origin, direction, **options)

    monkeypatch.setattr(RayCaster, "intersect", counted)
    return counts


def test_a_pair_that_stands_still_casts_one_ray_a_pixel(measurement: StereoMeasurement, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, counts = stereo_residuals(measurement), _casts(monkeypatch)
    known = with_surroundings(measurement, plain)
    found = stereo_residuals(known)
    assert counts == [len(measurement.cloud.points)]
    for name in ("value", "usable", "on_smooth_surface"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))
    np.testing.assert_array_equal(found.covariates["edge_step"], plain.covariates["edge_step"])
    some = np.arange(0, len(plain), 7)
    np.testing.assert_array_equal(
        stereo_residuals(known.part(plain.index[some])).on_smooth_surface, plain.on_smooth_surface[some]
    )


def test_pixels_that_see_other_places_are_looked_at_again(
    measurement: StereoMeasurement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Surroundings known for places a third of a pixel away are reused; for places five pixels away they are cast again."""
    expected = stereo_residuals(measurement)
    about = with_surroundings(measurement, expected).surroundings
    assert about is not None
    depth = float(np.nanmedian(np.linalg.norm(about.point - measurement.viewpoint, axis=1)))
    pixel_m = depth / float(measurement.cameras.left.f_px)
    assert not expected.on_smooth_surface.all()
    for pixels, again in ((0.3, False), (5.0, True)):
        beside = Surroundings(
            about.point + np.array([pixels * pixel_m, 0, 0]),
            np.zeros(len(about.point)),
            np.zeros_like(about.hidden),
            np.zeros_like(about.gradient),
        )
        counts = _casts(monkeypatch)
        found = stereo_residuals(measurement.changed(surroundings=beside))
        assert (max(counts[1:], default=0) > 0.9 * len(found)) == again
        np.testing.assert_array_equal(
            found.on_smooth_surface, expected.on_smooth_surface if again else np.ones(len(found), dtype=bool)
        )
        monkeypatch.undo()

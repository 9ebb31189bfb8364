"""Errors of a stereo matcher that reach over steep rock: windows that take the nearest rock, and biases by the gradient."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.gap_closed_form import stereo_cases, stereo_effects
from benchmarks.gap_closed_form.cases import Case, make
from benchmarks.gap_closed_form.strength import Strength
from pipeline.formats.measurements.measurement import StereoMeasurement, read_measurement
from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.naming.candidate_families import catalogue_families
from pipeline.gap.naming.named_effects import within_bounds
from pipeline.gap.naming.selection_passes import PassInputs
from pipeline.gap.noise_and_edges import disparity_edges
from pipeline.gap.noise_and_edges.disparity_edges import align_beside_fattening, find_disparity_edge_effects
from pipeline.gap.residuals.alignment import align, compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.disparity_raster import raster_cell_px
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.wall_blocks import BlockGrid
from scene.common.keyed_random import KeyedRandom
from sensors.effects import effect_of
from sensors.effects.edge_fattening import EdgeFattening


def measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, error: Any) -> StereoMeasurement:
    """Return a stereo pair of the closed-form generator to whose raster of disparities `error` is applied."""
    monkeypatch.setattr(stereo_cases, "_drawn", lambda *_: [("edge_fattening", {}, Strength(0.0, "", 0.0))])
    monkeypatch.setattr(stereo_effects, "raster_effect", lambda _name, _p, disparity, step: error(disparity, step))
    make(
        Case(0, (seed, 5), "one", "stereo", ("edge_fattening",), 12_000, 12_000),
        tmp_path / "case",
        tmp_path / "truth.json",
        baselines=False,
    )
    found = read_measurement(tmp_path / "case")
    assert isinstance(found, StereoMeasurement)
    return found


@pytest.mark.parametrize(("seed", "cells", "step_px"), [(1, 1, 1.0), (3, 3, 1.0), (1, 2, 7.0)])
def test_a_window_that_takes_the_nearest_rock_is_found_beside_its_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, cells: int, step_px: float
) -> None:
    """A small step changes most disparities of a steep wall, so that the pose that fits best without it is off.

    A large one lies between those that are tried first, and few points show it.
    """

    def nearest(disparity: Any, _step: int) -> Any:
        largest = ndimage.maximum_filter(np.where(np.isnan(disparity), -np.inf, disparity), 2 * cells + 1)
        return np.where(largest - disparity > step_px, largest, disparity)

    there = measured(tmp_path, monkeypatch, seed, nearest)
    initial = compute_residuals(there)
    assert isinstance(initial, StereoResiduals)
    aligned = align(there, None, initial)
    with monkeypatch.context() as patched:
        patched.setattr(disparity_edges, "_SPOILT", 100.0)  # more than the wrong pose costs anywhere
        assert align_beside_fattening(there, initial, aligned, initial.index) is aligned
    found = align_beside_fattening(there, initial, aligned, initial.index)
    assert isinstance(found.measurement, StereoMeasurement)
    assert isinstance(found.residuals, StereoResiduals)
    nothing = np.zeros(len(found.residuals), dtype=bool)
    registered = fit_pose_robustly(found.residuals)[0]
    effects = find_disparity_edge_effects(found.measurement, found.residuals, registered, nothing)
    (named,) = (each for each in effects if each.name == "edge_fattening")
    assert isinstance(named.effect, EdgeFattening)
    step = raster_cell_px(initial.geometry.u, initial.geometry.v)
    assert step is not None
    assert named.effect.window == "square"
    assert named.effect.step_px == pytest.approx(step_px, rel=0.25)
    assert named.effect.radius_px == pytest.approx(cells * step, abs=2 * named.std["radius_px"])
    inputs = PassInputs(
        found.measurement, found.residuals, np.zeros(len(there.cloud.points), dtype=bool), BlockGrid(np.zeros(2), 1.0)
    )
    (again,) = inputs.edge_effects_given([])
    assert isinstance(again.effect, EdgeFattening)
    assert (again.effect.window, again.effect.radius_px) == ("square", named.effect.radius_px), "it starts from the first pose"


@pytest.mark.parametrize(("seed", "share", "along"), [(2, 0.6, False), (3, 0.4, True)])
def test_a_bias_by_the_gradient_is_named_with_its_slope(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, share: float, along: bool
) -> None:
    """The gradient is that between neighbouring cells; between them the rock has relief that the matcher does not see."""

    def biased(disparity: Any, _step: int) -> Any:
        down, right = np.gradient(disparity)
        return disparity + np.nan_to_num(np.clip(share * (right if along else np.hypot(down, right)), -1, 1))

    there, residuals, _ = align(measured(tmp_path, monkeypatch, seed, biased))
    assert isinstance(residuals, StereoResiduals)
    step = raster_cell_px(residuals.geometry.u, residuals.geometry.v)
    assert step is not None
    part = residuals.part(residuals.usable)
    families = [each for each in catalogue_families(there, part) if isinstance(each, Candidate)]
    search = MeanSearch(part, list(families), KeyedRandom(1))
    chosen, _ = search.select()
    (best,) = (each.candidate for each in chosen if each.candidate.name == "fronto_parallel_bias")
    assert best.names == (("row_px",) if along else ("slope_px",))
    design = search.design
    together = [best, *(each.candidate for each in chosen if each.candidate is not best)]
    value = design.split_coefficients(design.fit(together).coefficients, together)[0]
    assert float(value[0]) == pytest.approx(share * step, rel=0.3)  # linearised, at a pose that the bias moved
    entry = {"name": best.name, **best.fixed, **best.parameters(value)}
    assert within_bounds(there.model, entry)
    made = effect_of(best.name)(**{key: each for key, each in entry.items() if key != "name"})
    np.testing.assert_allclose(made.mean(part.geometry), best.columns @ value, atol=1e-9)

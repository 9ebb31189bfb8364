"""The misfit is tested anew where validation keeps only some of the selected effects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gap_cases import Array, Scan, write_scan

from pipeline.formats.measurements.measurement import Measurement, read_measurement
from pipeline.gap.mean.candidates import Candidate, SineGrid
from pipeline.gap.naming import effect_selection, search_beside_effects
from pipeline.gap.naming.candidate_families import candidate_families
from pipeline.gap.naming.named_effects import aligned_with
from pipeline.gap.residuals.alignment import align, fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from scene.common.keyed_random import KeyedRandom

TRUE = "range_cyclic", "range_incidence_bias"


def _ranges(scan: Scan) -> Array:
    """Return ranges with a cyclic error of 4 mm, and an error of up to centimetres that grows with the incidence angle."""
    return scan.R + 0.004 * np.sin(2 * np.pi * scan.R / 3.0) + 0.006 * (1 / scan.cos_i - 1)


def _few(measurement: Measurement, part: Residuals, *_: Any) -> list[Candidate | SineGrid]:
    return [each for each in candidate_families(measurement, part) if each.name in (*TRUE, "range_offset", "range_scale")]


def _start(measurement: Measurement, part: Residuals) -> effect_selection.SelectionStart:
    """Start a selection of effects."""
    given = effect_selection.SelectionInput(measurement, part, fit_pose_robustly(part)[2], KeyedRandom(1))
    return effect_selection.SelectionStart.of(given)


def test_what_one_of_two_true_effects_leaves_is_significant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scan(tmp_path, 5, step_rad=0.009, ranges=_ranges)
    monkeypatch.setattr(effect_selection, "candidate_families", _few)
    monkeypatch.setattr(search_beside_effects, "candidate_families", _few)
    there, residuals, _ = align(read_measurement(tmp_path))
    part = residuals.part(residuals.usable)
    named, result = effect_selection.select_effects(_start(there, part))
    systematic = [item for item in named if not item.adds_variance]
    assert {item.name for item in systematic} == {f"tls.{name}" for name in TRUE}
    both = result.p_value_given(systematic)
    assert both is not None
    assert both > 0.01
    for kept in systematic:
        alone = result.p_value_given([kept])
        assert alone is not None, "the misfit beside a part of the effects was not tested"
        assert alone <= 0.01


def test_an_outline_explains_what_is_systematic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick search before the selection finds both errors; the residuals beside them are as small as the noise."""
    write_scan(tmp_path, 5, step_rad=0.009, ranges=_ranges)
    monkeypatch.setattr(effect_selection, "candidate_families", _few)
    there, residuals, _ = align(read_measurement(tmp_path))
    part = residuals.part(residuals.usable)
    before, outline = fit_pose_robustly(part)[2], _start(there, part).outline()
    assert {item.name for item in outline} == {f"tls.{name}" for name in TRUE}
    left = aligned_with(there, outline).residuals
    assert fit_pose_robustly(left.part(left.usable))[2] < 1.05 < before


def test_an_empirical_term_that_is_kept_counts_in_the_misfit_that_is_left(tmp_path: Path) -> None:
    """The ranges follow a smooth curve of the azimuth, which no effect of the catalogue describes."""
    write_scan(tmp_path, 5, step_rad=0.009, ranges=lambda scan: scan.R + 0.004 * np.tanh(8 * (scan.az - 1.6)))
    there, residuals, _ = align(read_measurement(tmp_path))
    part = residuals.part(residuals.usable)
    named, result = effect_selection.select_effects(_start(there, part))
    assert "empirical" in {item.kind for item in named}
    assert result.systematic == {item.name for item in named if not item.adds_variance}
    assert result.p_value_given(named) == result.p_value
    assert result.p_without_effects is not None
    assert result.p_without_effects <= 0.01

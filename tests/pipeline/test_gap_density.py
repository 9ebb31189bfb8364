"""More points of the same wall must not make the diagnosis worse: it gives the same name and an error that does not grow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from gap_cases import write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.naming.candidate_families import candidate_families
from pipeline.gap.residuals.alignment import align
from scene.common.keyed_random import KeyedRandom

TRUE = 0.008
STEPS = (0.013, 0.006)
BENT = 0.055


def _search(folder: Path, step_rad: float, bent: float = BENT) -> tuple[list[str], float, float, float]:
    """Return the chosen effects for 8 mm of incidence bias on a rough wall, its value and standard deviation, and the points.

    bent: relative departure of the error from the effect's form, as a wave along the incidence angle; white noise of 1 mm is
    added.
    """
    folder.mkdir()
    write_scan(folder, 5, step_rad=step_rad, ranges=lambda scan: scan.R)
    there, residuals, _ = align(read_measurement(folder))
    part = residuals.part(residuals.usable & (residuals.geometry.cos_incidence > 0.3))
    slant = 1 / part.geometry.cos_incidence - 1
    noise = 0.001 * np.random.default_rng(6).standard_normal(len(part))
    value = TRUE * (slant + bent * np.std(slant) * np.sin(6 * part.covariates["incidence"])) + noise
    part = replace(part, value=value, sigma=np.full(len(part), 0.001))
    search = MeanSearch(part, candidate_families(there, part), KeyedRandom(1))
    chosen, _ = search.select()
    names = [each.candidate.name for each in chosen]
    ours = next((each.candidate for each in chosen if each.candidate.name == "range_incidence_bias"), None)
    if ours is None:
        return names, np.nan, np.nan, len(part)
    fit = search.design.fit([ours])
    return names, float(fit.coefficients[-1]), float(np.sqrt(fit.covariance[-1, -1])), len(part)


def test_a_denser_scan_keeps_the_name_and_the_value(tmp_path: Path) -> None:
    """4,500 and 21,000 points of an error that departs from the effect's form by 5.5 % of its size (1.1 % of the gain)."""
    (few, coarse, wide, fewer), (many, fine, narrow, more) = (_search(tmp_path / f"at_{step}", step) for step in STEPS)
    assert few == many == ["range_incidence_bias"]
    assert all(abs(value - TRUE) < 3 * std + BENT * TRUE for value, std in ((coarse, wide), (fine, narrow)))
    assert narrow < 0.6 * wide
    assert more > 4 * fewer


def test_a_free_form_of_its_own_is_still_asked_for_beside_an_effect(tmp_path: Path) -> None:
    """The effect leaves 20 % of the error unexplained, which is more than a lack of precision."""
    names = _search(tmp_path / "scan", 0.0065, 0.2)[0]
    assert "incidence" in names

"""The last step of `gap`: what makes the model predict worse is taken out again, what makes it predict better stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gap_cases import write_scan

from pipeline.gap.cells import Cells, held_out_blocks
from pipeline.gap.entries import Named
from pipeline.gap.measurement import read_measurement
from pipeline.gap.registration import settled
from pipeline.gap.showing import Showing
from scene.keyed_random import KeyedRandom


def test_a_harmful_effect_is_taken_out_and_a_true_one_stays(tmp_path: Path) -> None:
    """Ranges grow with the incidence angle; beside that a noise is named that is not there, ten times the true one."""
    write_scan(tmp_path, 8, ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1), step_rad=0.007)
    there, residuals, _ = settled(read_measurement(tmp_path))
    held_out = held_out_blocks(residuals.at, Cells.over(residuals.at).side_m)
    showing = Showing(
        measurement=there,
        residuals=residuals,
        chosen=np.flatnonzero(residuals.smooth & ~held_out),
        tested=residuals.smooth & held_out,
        learned=residuals.smooth & ~held_out,
        losses=None,
        reference_sigma=0.0004,
        largest=20.0,
        random=KeyedRandom(1),
    )
    true, wrong = (
        Named(f"tls.{name}", "physical", {"name": name, key: value}, {}, (), 0.001, 10.0)
        for name, key, value in (("range_incidence_bias", "coefficient_m", 0.01), ("range_noise", "sigma_m", 0.03))
    )
    shown, words = showing.show([wrong, true])
    assert shown.named == [true]
    assert len(words) == 1
    assert words[0].startswith("tls.range_noise dropped")
    assert shown.gap is not None
    assert (shown.gap.closed or 0.0) > 0.8

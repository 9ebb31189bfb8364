"""A best value outside an effect's bounds, which no config may hold, excludes the effect; the diagnosis still ends in
a verdict.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import annotated_types
import pytest
from gap_cases import Scan, write_scan

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.named_effects import NamedEffect, only_within_bounds, with_effects
from pipeline.gap.naming.workflow import diagnose
from sensors.effects import STEREO_EFFECTS, TLS_EFFECTS
from sensors.models.sensor_model import StereoModel, TlsModel


def _bounded() -> list[tuple[str, str, str, float]]:
    """Return sensor, effect, parameter and largest allowed value of all parameters that have one."""
    found = []
    for effect in (*TLS_EFFECTS, *STEREO_EFFECTS):
        for key, info in effect.model_fields.items():
            found += [
                (effect.sensor, str(effect.model_fields["name"].default), key, float(each.le))  # type: ignore[arg-type]
                for each in info.metadata
                if isinstance(each, annotated_types.Le)
            ]
    return found


@pytest.mark.parametrize(("sensor", "name", "key", "largest"), _bounded(), ids=lambda each: str(each))
def test_an_effect_beyond_its_bounds_is_left_out_and_the_others_stay(sensor: str, name: str, key: str, largest: float) -> None:
    model = TlsModel() if sensor == "tls" else StereoModel()
    other, value = ("range_noise", 0.001) if sensor == "tls" else ("parallax_noise", 0.1)
    key_of_other = "sigma_m" if sensor == "tls" else "sigma_px"
    wide, good = _named(sensor, name, {key: 1.5 * largest + 1.0}), _named(sensor, other, {key_of_other: value})
    kept, words = only_within_bounds(model, [wide, good])
    assert kept == [good]
    assert words == [f"{sensor}.{name} left out: its best value is outside the bounds of the effect"]
    assert with_effects(model, [item.entry for item in kept]).effects


def _named(sensor: str, name: str, values: dict[str, Any]) -> NamedEffect:
    return NamedEffect(f"{sensor}.{name}", "physical", {"name": name, **values}, {}, (), 0.001, 10.0)


def test_noise_whose_coefficient_no_config_may_hold_ends_in_a_verdict(tmp_path: Path) -> None:
    """The intensities are a recorder's counts instead of relative powers, so noise by intensity would need a coefficient of
    40 m.
    """

    def ranges(scan: Scan) -> Any:
        noisy = scan.R + 0.004 * scan.power**-0.5 * scan.rng.standard_normal(len(scan.R))
        scan.power *= 1e8
        return noisy

    write_scan(tmp_path, 10, ranges=ranges, step_rad=0.007)
    found = diagnose(read_measurement(tmp_path))
    assert found.verdict != "no_gap"
    assert not [effect for effect in found.effects if effect.name == "tls.range_noise_intensity"]
    assert "range_noise_intensity left out: its best value is outside the bounds of the effect" in found.remaining["note"]

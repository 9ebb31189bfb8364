"""`plan_series` gives what `inspect --series` predicts, as tables."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline import plan_series
from pipeline.planning import series as planning
from pipeline.planning.series_report import series_summary
from scene.common.errors import InputError

SMALL: dict[str, Any] = {
    "seed": 3,
    "wall": {"style": "glendale", "width_m": 10.0, "height_m": 7.0, "resolution_m": 0.06, "seed": 1},
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.002, "zenith_step_rad": 0.002},
    "sensor": [{"sensor": "tls", "noise": {"range_sigma_m": 0.002}}],
}
SERIES: dict[str, Any] = {
    "times": {"start": "2026-03-01T00:00:00Z", "every_h": 2, "count": 4},
    "rockfall": {"rate_per_day": 10, "volume_m3": {"power_law": {"smallest": 0.03, "largest": 0.3}}},
    "precursor": {"lead_h": 48, "displacement_m": 0.05},
}


def test_the_tables_hold_what_the_command_prints(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "_ENOUGH", 10)
    monkeypatch.setattr(planning, "_MOST_TRIALS", 3)
    monkeypatch.setattr(planning, "AVERAGED", (1,))
    plans = plan_series({**SMALL, "series": SERIES}, "tls", progress=False)
    assert len(plans) == 1
    plan = plans[0]
    row = plan.smallest.loc[1]
    assert row["low_m3"] <= row["volume_m3"] <= row["high_m3"]
    assert plan.probability(row["volume_m3"]) == pytest.approx(0.95)
    leads = plan.leads
    assert leads["every_h"].unique().tolist() == [1, 2, 24, 168]
    assert sorted(leads["volume_m3"].unique()) == pytest.approx([0.03, (0.03 * 0.3) ** 0.5, 0.3])
    first = leads.iloc[0]
    assert plan.probability(first["volume_m3"], first["shows_from_m"]) == pytest.approx(0.95)
    assert (leads["lead_h_95"] <= leads["lead_h_median"]).all()
    assert plans.summary() == series_summary(plan.promise)
    assert plan.promise.to_dict()["epochs"][0]["precursors"][0]["schedules"][0]["lead_h_95"] == first["lead_h_95"]
    assert plans.plot().png.startswith(b"\x89PNG")
    assert "SeriesPlans: tls" in repr(plans)
    assert "are listed in 95 %" in plans._repr_html_()
    with pytest.raises(InputError, match=r"scans: the number of scans in an epoch is 4; allowed: 1"):
        plan.probability(0.1, scans=4)


def test_a_config_without_a_series_is_refused() -> None:
    with pytest.raises(InputError, match="the config has no series of rockfalls"):
        plan_series(SMALL, "tls", progress=False)

"""The report of `gap`: one for every verdict, one sign convention for both sensors, labels that can be read."""

from __future__ import annotations

import io
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gap_cases import write_scan
from matplotlib.figure import Figure
from matplotlib.text import Text

from pipeline.cli.main import main
from pipeline.formats.measurements.measurement import Measurement, read_measurement
from pipeline.formats.points.laz import read_laz
from pipeline.gap.naming.gap_score import Gap
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.naming.separating_measurements import measurement_separating_noises
from pipeline.gap.naming.verdict import VERDICTS
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.report import figures, report
from pipeline.gap.report.contributions import contributions
from pipeline.gap.report.covariate_ranking import rank_disagreements
from pipeline.gap.report.figures import gap_figure, maps_figure
from pipeline.gap.report.quantities import format_with_std
from pipeline.gap.report.wording import paragraph
from pipeline.gap.residuals.nominal_pair import PixelGeometry
from pipeline.gap.residuals.residuals import ExpectedPulses
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.thresholds import read_thresholds
from sensors.models.sensor_model import StereoModel

FILES = {"gap.json", "model_after.yaml", "before.laz", "after.laz", "report.html"}
GAP = Gap(before=0.004, after=0.0011, floor=0.001, error=0.0002, floor_error=0.0002, points=900)
NAMED = NamedEffect(
    "tls.range_offset", "physical", {"name": "range_offset", "offset_m": 0.004}, {"offset_m": 3e-10}, (), 0.002, 80.0
)
ALIKE = replace(NAMED, indistinguishable=("tls.range_scale",), split_by="a second station at another range")
EMPIRICAL = replace(NAMED, name="tls.range_empirical", kind="empirical", entry={"name": "range_empirical", "covariate": "zenith"})
EFFECTS = {"named": (NAMED,), "several": (NAMED, NAMED), "ambiguous": (ALIKE,), "unknown": (EMPIRICAL,)}
MATRIX = {"names": ["tls.range_offset", "tls.range_scale"], "cosines": [[1.0, 0.5], [0.5, 1.0]], "survival": [0.5, 0.2]}


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> tuple[GapDiagnosis, Measurement]:
    """A diagnosis of a few hundred points."""
    folder = tmp_path_factory.mktemp("few")
    write_scan(folder, 1, step_rad=0.05)
    measurement = read_measurement(folder)
    return diagnose(measurement), measurement


@pytest.fixture(scope="module")
def drawn(few: tuple[GapDiagnosis, Measurement]) -> dict[bool, dict[str, bytes]]:
    """The figures with and without scores and a table of similarities; they are the same for every verdict."""
    whole = replace(few[0], gap=GAP, identifiability=MATRIX)
    return {True: report._pictures(whole), False: report._pictures(replace(few[0], gap=None))}


@pytest.mark.parametrize(
    ("name", "alike", "expected"),
    [
        ("tls.range_noise", "tls.range_noise_proportional", "the same rock from another range"),
        ("tls.range_noise_incidence", "tls.range_noise", "the same rock at another angle of incidence"),
        ("stereo.parallax_noise", "stereo.regularization_noise", "disparities of every pixel"),
    ],
)
def test_noises_are_split_by_what_they_depend_on(name: str, alike: str, expected: str) -> None:
    """The proposed measurement varies what tells two noises apart.

    A second distance does not tell white from smoothed disparities.
    """
    item = NamedEffect(name, "physical", {"name": name.partition(".")[2]}, {}, (alike,), 0.002, 80.0)
    assert measurement_separating_noises(item, name.partition(".")[0]).startswith(expected)


@pytest.mark.parametrize("pictures", [True, False])
@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_has_a_report(
    few: tuple[GapDiagnosis, Measurement],
    drawn: dict[bool, dict[str, bytes]],
    verdict: str,
    pictures: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, measurement = few
    told = verdict != "insufficient_data"
    case = replace(
        found,
        verdict=verdict,
        effects=EFFECTS.get(verdict, ()),
        gap=GAP if told and pictures else None,
        identifiability=MATRIX if told and pictures else found.identifiability,
        remaining={**found.remaining, "p_value": 0.3 if told else None, "note": ""},
    )
    monkeypatch.setattr(report, "_pictures", lambda case: drawn[case.gap is not None] if pictures else {})
    page = report.write_report(tmp_path, case, measurement).read_text()
    assert {path.name for path in tmp_path.iterdir()} >= FILES
    assert VERDICTS[verdict] in page
    assert ("effect_2_m" in read_laz(tmp_path / "before.laz").extra) == (verdict == "several")
    assert ("What to measure" in page) == (not told)
    assert ("What it means, and what to do" in page) == (verdict in EFFECTS)
    order = ["What it means", "Where they disagree", "What was named", "<h2>The gap", "What was tried", "The model after"]
    places = [page.index(title) for title in order if title in page]
    assert places == sorted(places)
    assert "On validation blocks, which no fit has used" not in page[: page.index("</p>")]  # the scores are evidence, no headline
    if verdict == "unknown":
        assert "_empirical (covariate" in report.summarise(case)
    assert ("± &lt; 0.001 mm" in page) == (verdict in ("named", "several", "ambiguous"))


def test_what_is_closed_is_said_by_the_thresholds_of_the_diagnosis(few: tuple[GapDiagnosis, Measurement]) -> None:
    """The thresholds of the diagnosis apply wherever it is written.

    At a significance level of 1e-300, which 37 standard errors reach, a gap of 20 is none.
    """
    found, measurement = few
    gap = Gap(before=0.006, after=0.001, floor=0.001, error=2.5e-4, floor_error=2.5e-4, points=100)
    strict = read_thresholds(["verdict.gap_sigmas=1000", "verdict.rejection_p=1e-300"])
    assert report.to_dict(replace(found, gap=gap), measurement)["gap"]["closed"] == 1.0
    assert report.to_dict(replace(found, gap=gap, thresholds=strict), measurement)["gap"]["closed"] is None


@pytest.mark.parametrize(("count", "starts"), [(1, ["It is"]), (3, ["One effect is", "Another one is", "Another one is"])])
def test_the_paragraph_counts_the_named_effects(few: tuple[GapDiagnosis, Measurement], count: int, starts: list[str]) -> None:
    said = paragraph(replace(few[0], effects=(NAMED,) * count), [])
    assert re.findall(r"([A-Z][a-z]+(?: effect| one)? is) tls\.", said) == starts


def test_each_of_several_effects_says_what_it_takes_away(few: tuple[GapDiagnosis, Measurement]) -> None:
    """Two equal effects each take away the same amount, at most the 4 mm of a range offset."""
    found, measurement = few
    first, second = contributions(replace(found, effects=(NAMED, NAMED)), measurement)
    np.testing.assert_array_equal(first, second)
    assert 0 < np.abs(first).max() < 0.0045
    assert contributions(replace(found, effects=()), measurement).shape == (0, len(found.before))


@pytest.mark.parametrize(("verdict", "told"), [("unknown", True), ("no_gap", True), ("named", False)])
def test_the_terminal_shows_remarks_where_no_name_explains(
    few: tuple[GapDiagnosis, Measurement], verdict: str, told: bool
) -> None:
    """Remarks say what an answer without a name found, such as seams of tiles; a named effect speaks for itself."""
    found = replace(few[0], verdict=verdict, remaining={**few[0].remaining, "note": "the disparities jump"})
    assert ("  note: the disparities jump" in report.summarise(found).splitlines()) is told


def test_nothing_is_written_where_the_report_cannot_be_made(
    few: tuple[GapDiagnosis, Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> str:
        raise RuntimeError("a fault in the page")

    monkeypatch.setattr(report, "_pictures", lambda _: {})
    monkeypatch.setattr(report, "_render_page", broken)
    with pytest.raises(RuntimeError, match="a fault"):
        report.write_report(tmp_path / "out", *few)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("count", "areas"), [(1, []), (3, []), (50, []), (300, []), (None, [[20.0, 10.0, 24.0, 14.0]])])
def test_too_few_points_are_answered_with_what_to_measure(
    count: int | None, areas: list[list[float]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case, out = tmp_path / "case", tmp_path / "out"
    case.mkdir()
    write_scan(case, 1, step_rad=0.03, stable_areas=areas)
    if count is not None:
        _keep(case / "scan_0.ply", count)
    assert main(["gap", str(case), "--out", str(out), "--quiet"]) == 0
    assert {path.name for path in out.iterdir()} >= FILES
    told = capsys.readouterr().out
    assert told.startswith("insufficient_data")
    assert "800 are needed" in told
    assert "stable_areas" in told


def _keep(path: Path, count: int) -> None:
    """Keep the first `count` points of a binary PLY file of five doubles each."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, dtype="<f8").reshape(-1, 5)
    chosen = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
    lines = [f"element vertex {count}".encode() if line.startswith(b"element") else line for line in head.splitlines()]
    path.write_bytes(b"\n".join([*lines, b"end_header\n"]) + chosen.tobytes())


@pytest.mark.parametrize("sensor", ["tls", "stereo"])
def test_missing_rock_is_positive_of_both_sensors(
    few: tuple[GapDiagnosis, Measurement], sensor: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A surface 20 mm behind the reference has positive residuals in both sensors.

    The ranges are 20 mm longer, the disparities smaller by 20 mm over the depth of a pixel.
    """
    monkeypatch.setattr(report, "_pictures", lambda _: {})
    found, measurement = few
    unit = 1.0 if sensor == "tls" else 0.25
    deeper = np.full(len(found.residuals), 0.02 / unit if sensor == "tls" else -0.02 / unit)
    sigma = np.full(len(deeper), 0.01 / unit)
    residuals = replace(found.residuals, unit_m=np.full(len(deeper), unit), sigma=sigma, value=deeper)
    case = replace(found, residuals=residuals, before=deeper, after=deeper)
    if sensor == "stereo":
        own = {field.name: getattr(residuals, field.name) for field in fields(StereoResiduals)}
        geometry = PixelGeometry(**dict.fromkeys((field.name for field in fields(PixelGeometry)), deeper))
        case = replace(case, residuals=StereoResiduals(**own | {"geometry": geometry}), model_after=StereoModel())
    report.write_report(tmp_path, case, measurement)
    for name in ("before", "after"):
        np.testing.assert_allclose(read_laz(tmp_path / f"{name}.laz").extra["residual_m"], 0.02, rtol=1e-12)
    means = [row["size_m"] for row in rank_disagreements(case) if row["statistic"] == "mean"]
    assert means
    np.testing.assert_allclose(means, 0.02, rtol=1e-9)


def test_missing_rock_is_red_and_one_bad_cell_does_not_set_the_colours(
    few: tuple[GapDiagnosis, Measurement], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = few
    values = 0.003 * np.random.default_rng(5).standard_normal(len(found.residuals))
    bad = np.where(np.arange(len(values)) < 0.03 * len(values), 50.0, values)
    images = _drawn(monkeypatch, lambda: maps_figure(replace(found, before=bad, after=bad))).axes[0].images
    (image,) = images
    assert 3.0 < image.get_clim()[1] < 30.0  # mm, of noise of 3 mm
    red, _, blue, _ = image.to_rgba(20.0)
    assert red > blue


def test_labels_of_the_gap_do_not_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scores may be equal or different; the error bars end within the axes."""
    for gap in (GAP, replace(GAP, before=0.001, after=0.001), replace(GAP, before=0.0010001, after=0.0012, floor_error=0.1)):
        figure = _drawn(monkeypatch, lambda gap=gap: gap_figure(gap))
        (panel,) = figure.axes
        boxes = [text.get_window_extent() for text in panel.texts if isinstance(text, Text)]
        assert len(boxes) == 3
        assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[:number])
        low, high = panel.get_xlim()
        assert low < 1e3 * (gap.after - 2 * gap.floor_error) < 1e3 * (gap.before + 2 * gap.error) < high


def _drawn(monkeypatch: pytest.MonkeyPatch, draw: Any) -> Figure:
    """Return the figure that is saved as a PNG."""
    kept: list[Figure] = []

    def keep(figure: Figure, dpi: int = 110) -> bytes:
        kept.append(figure)
        figure.savefig(io.BytesIO(), dpi=dpi)
        return b""

    monkeypatch.setattr(figures, "png", keep)
    draw()
    return kept[0]


@pytest.mark.parametrize(
    ("key", "value", "std", "shown"),
    [
        ("step_m", 0.0082523077, 3e-10, "8.252 ± < 0.001 mm"),
        ("offset_m", 0.00402, 5e-5, "4.02 ± 0.05 mm"),
        ("offset_m", -0.00402, 9.96e-5, "-4.02 ± 0.10 mm"),
        ("position_m", 2.5, 0.001, "2.5000 ± 0.0010 m"),
        ("offset_rad", 1.1e-4, 4e-6, "110 ± 4 µrad"),
        ("sigma_px", 0.486, 0.0123, "0.486 ± 0.012 px"),
        ("lines_per_cycle", 37.0, 1e-9, "37.000 ± < 0.001"),
        ("scale", 1.2, 300.0, "0 ± 300"),
        ("offset_m", 0.004, None, "4 mm"),
        ("minimum_power", 1.2e-9, 1e-10, "1.2e-09 ± 1e-10"),
    ],
)
def test_a_value_ends_where_its_uncertainty_does(key: str, value: float, std: float | None, shown: str) -> None:
    assert format_with_std(key, value, std) == shown


def test_losses_behind_shrubs_are_told_from_losses_by_a_covariate(few: tuple[GapDiagnosis, Measurement]) -> None:
    """Losses behind shrubs do not pass for losses that depend on a covariate.

    There are 24,000 pulses on 40 m x 20 m, one in a hundred lost. Behind each of six shrubs of 0.8 m all of about 60 are lost,
    which is 8 standard deviations of as many independent pulses as a bin has. Of 60 draws at most 3 may have a p-value below
    0.01; with this seed none has. A loss of 20 % more in half of the wall shows in each draw, with the shrubs before it.
    """
    random = np.random.default_rng(6)
    few_found, _ = few
    least = {False: [], True: []}
    for half in [False] * 60 + [True] * 20:
        at = random.uniform(0, 1, (24_000, 2)) * (40, 20)
        lost = random.uniform(0, 1, len(at)) < 0.01 + 0.2 * (half & (at[:, 0] > 20))
        for centre in random.uniform(0, 1, (6, 2)) * (40, 20):
            lost |= np.hypot(*(at - centre).T) < 0.8
        missing = ExpectedPulses(lost, {"azimuth": at[:, 0]}, at)
        rows = rank_disagreements(replace(few_found, residuals=replace(few_found.residuals, expected_pulses=missing)))
        least[half] += [row["p_value"] for row in rows if row["statistic"] == "missing"] or [1.0]
    assert sum(p < 0.01 for p in least[False]) <= 3
    assert all(p < 0.01 for p in least[True])

"""Write the results as a page of the documentation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

Json = dict[str, Any]
_SENSORS = {"tls": "laser scanner", "stereo": "stereo pairs"}
_ANSWERS = (
    "right, alone",
    "right, in a class",
    "other effect only",
    "wrong name",
    "unknown",
    "no_gap",
    "insufficient_data",
    "error",
)

_NUISANCES = """| always present | size |
| --- | --- |
| pose | wrong by millimetres and some 10 microradians, as if from a survey |
| error of the reference | 0.2 to 0.8 mm for the laser, 1 to 4 mm for stereo, correlated over 1.5 to 6 m |
| albedo | varies smoothly and from point to point |
| missing returns | 1 to 2 %; in a third of the cases also shrubs (round patches without returns) |
| changes of the scene | fallen blocks and debris in all cases but those without an effect |
| optional fields of a measurement (such as intensity or time) | each absent in a quarter of the cases |
| effects that the sensor model states already, rightly | in one of eight laser cases |

The strengths S/N of the effects are spread evenly in their logarithm from 2 to 120, up to three times the largest typical size
that the catalogue states."""

_LABELS = {
    "false alarms on no-effect cases": "false alarms: the verdict is not `no_gap`, though there is no effect",
    "right class at S/N x sin(angle) of 8 or more": "clear effects in the right class, in measurements with one effect",
    "wrong names among committed answers": "wrong names among the answers that name an effect",
    "the class contains the truth": "named classes that contain the true effect, in measurements with one effect",
    "median size of the class": "median number of effects in a class",
    "off-catalogue effects answered unknown": "clear errors outside the catalogue that are answered `unknown`",
    "two effects at once, both classes right": "two clear effects at once, both classes right",
    "real change blamed on the sensor": "false alarms where only rock fell",
    "gap closed on held-out data, effects named (median)": "share of the gap that the named effects close on validation blocks, "
    "if all true effects are named (median)",
    "gap closed, all cases' metres summed": "the same share, of the gaps of all measurements added up",
    "gap closed by the best wrong effect outside the class (median)": "share of the gap that the best wrong effect outside the "
    "class closes, if one clear effect was to be named (median)",
    "the same, as the angle to the nearest other effect lets it (1 - sin^2, median)": "its expectation from the angle to the "
    "nearest other effect, 1 - sin^2 (median)",
    "the same, where that angle leaves it 5 % at most": "the share that it closes where the expectation is 5 % at most",
    "rightly named, but the gap is within its uncertainty": "answers that name all true effects although the gap is "
    "too small to be told from none",
    "the same, where every true effect was named": "the same intervals, where every true effect was named",
}
"""Rows of the results whose names need more words on the page."""

_OUTSIDE = """| error outside the catalogue | what it is |
| --- | --- |
| off_jump, off_column_step | a step of the ranges at one azimuth, of the disparities at one column |
| off_facets | range errors that repeat with the scan lines, as from the facets of a mirror |
| off_square_wave | a square wave of the range error over the range |
| off_azimuth_waves, off_column_waves | a sine over the azimuth, over the columns |
| off_column_banding | a square wave over the columns |
| off_quadratic, off_intensity_square | errors that grow with the square of the range, of the logarithm of the received power |
| off_drift | an error that decays during the scan |
| off_saddle, off_cubic, off_bump | smooth two-dimensional shapes over the scan or the image |
| off_spread_sector, off_spread_time | additional noise in a sector of azimuths, in two thirds of the time |
| off_spread_half, off_spread_radius | additional noise in half of the image, far from the middle of the image |
| off_loss_sector | lost returns in a sector of azimuths |"""

_HOW_TO_READ = """Each cell has a share with its counts and its 95 % interval (Wilson) in brackets, or a median with the
number of values in brackets; "(of 1)" is one value for all measurements together. Then it says whether the goal was met:
"yes", "no", or "undecided", which means that the interval contains values that reach the goal and values that do not. So few
measurements leave most goals undecided. The number after "of" is smaller than that of all measurements where a row is about some
of them alone, such as the clear ones."""

_READING = """The "share of the gap" is 100 % if nothing but noise is left. The rows on "the best wrong effect" put another effect
in place of the true one, to see whether it would do as well. It closes much of the gap wherever two signatures are alike: fitted
freely, an effect whose signature has the angle a to the true one explains 1 - sin^2 a of its sum of squares, whatever the method.
Where no other effect is alike, it closes next to nothing."""

_ANSWERS_READ = """| column or name | meaning |
| --- | --- |
| (none), (change) | measurements without an effect; those in which only rock fell |
| (off ...) | an error outside the catalogue, clear or weak; if it is answered `no_gap` and not among the failures, it is weak |
| right, alone; right, in a class | the true effect is named; it is one of those that cannot be told from a named one |
| other effect only | the measurement has two effects, and only the other one is named |
| wrong name | an effect is named that is not there |
| unknown | no name, but the verdict `unknown` or an empirical description |
| no_gap, insufficient_data | this [verdict](../reference/glossary.md#model-and-measurement), without a name |
| error | the program gave no answer |"""

_FAILURES_READ = """"Case" is the number of the measurement, and "effects" what it contains: `one` or `two` effects of the
catalogue, or an error outside it (`off`). "x sin" is S/N x sin(angle), and "nearest" the most similar effect of another class.
In an answer, `~` joins effects that cannot be told apart, and `empirical` stands for a description without a cause. "Missed" is a
clear effect that the answer does not have. "Called unknown" has an empirical description besides the right name."""


def markdown(found: Json) -> str:
    """docs/validation/gap_closed_form.md, or that of one sensor, from results.json."""
    sensor = _SENSORS.get(found["settings"].get("sensor", ""), "both sensors")
    parts = [
        f"# Measurements simulated in closed form: {sensor}",
        _introduction(found),
        _made_by(found),
        "## Results\n\n" + _HOW_TO_READ + "\n\n" + _figures(found["figures"], found["by_sensor"]),
        _READING,
        "## What the measurements hold\n\n" + _NUISANCES,
        "## Compared with two simple methods\n\nBoth take residuals as independent and give one name: the effect with the "
        "largest |z| (estimate over its standard error) above 3, or the best effect by the Bayesian information criterion (BIC) "
        "if it is ahead by more than 10.\nBoth find fewer of the clear effects, and raise many false alarms.\n\n"
        + _baselines(found),
        "## Answers by effect\n\nEach true effect counts once, also those of measurements with several effects, "
        "which the figures above leave out. Weak effects,\nwith S/N x sin(angle) below 8, are in brackets. "
        "A name that begins with `off_` is an error outside the catalogue.\n\n"
        + f"{_ANSWERS_READ}\n\n{_OUTSIDE}\n\n"
        + _by_effect(found["by_effect"]),
        "## Detection by strength\n\nThe measurements have one effect each, and a row has those whose ratio lies in its bin. "
        '"Found at all" counts any\nfinding, right or wrong, by bins of S/N. "Right class" counts right answers, by bins of '
        "S/N x sin(angle).\n\n" + _curves(found["detection"]),
        "## Coverage of the 90 % intervals\n\nFor each parameter of an effect that was named: how many of its 90 % intervals "
        'contain the true value ("inside"), of how many.\n\n' + _coverage(found["coverage"]),
        f"## Failures\n\n{_FAILURES_READ}\n\n" + _failures(found["failures"]),
    ]
    return "\n\n".join(parts) + "\n"


def _introduction(found: Json) -> str:
    """Say what was evaluated, and with which result."""
    figures = {row["what"].split(" at S/N")[0]: row for row in found["figures"]}

    def counted(what: str) -> str:
        return f"{figures[what]['successes']} of {figures[what]['count']}"

    return f"""This page shows how often `scarpsim gap` names the right effect in {_cases(found)} simulated measurements whose
truth it cannot see. It is for users who want to know how far to trust an answer. The generator (`benchmarks/gap_closed_form`)
works in closed form: surfaces and sensors are formulas, without meshes or ray casting. It shares no code with the sensors or
the diagnosis.

- {counted("right class")} clear effects are in the right class (measurements with one effect).
- {counted("wrong names among committed answers")} answers that name an effect contain a wrong name.
- {counted("false alarms on no-effect cases")} measurements without an effect raise a false alarm.

## Words

| word | meaning |
| --- | --- |
| effect | a sensor error of [the catalogue](../reference/effects/README.md) |
| signature | the pattern of residuals that an effect makes |
| class | effects that this measurement cannot tell apart: the angle between their signatures has a sine below 0.1 |
| floor | how far the measurement departs from the model where only noise is left, in m |
| gap | how much farther than the floor it departs |
| S/N | strength of an effect: signal-to-noise ratio of its signature after the pose fit; noise includes the reference's error |
| S/N x sin(angle) | what is left of S/N when the most similar effect of another class is fitted too |
| clear | an effect, or an error outside the catalogue, whose S/N x sin(angle) is 8 or more |
| validation blocks | parts of the wall that were not used to find effects |
| reference | the surface with which the measurement is compared |
| false alarm | an effect is named, or the verdict is `unknown`, though the sensor has no error |
| interval | the range of a parameter that the answer states; a 90 % interval should contain the truth in 90 % of the cases |
| `no_gap`, `unknown` | verdicts: measurement and model agree; they disagree, and no effect of the catalogue explains it |"""


def _cases(found: Json) -> int:
    """How many measurements were diagnosed."""
    return next(int(row["count"]) for row in found["figures"] if row["what"] == "cases without an answer")


def _made_by(found: Json) -> str:
    settings, seconds = found["settings"], found["seconds"]
    sensor = settings.get("sensor")
    page = f"docs/validation/gap_closed_form{f'_{sensor}' if sensor else ''}.md"
    words = f"python benchmarks/gap_closed_form/run.py --cases {settings['cases']} --seed {settings['seed']}"
    chosen = "".join(f" --{key} {settings[key]}" for key in ("stratum", "sensor") if key in settings)
    command = f"`{words}{chosen}{' --small' if settings['small'] else ''} --jobs 2 --out DIR --table {page}`"
    took = f"{seconds.get('median', 0):.0f} s (median), {seconds.get('longest', 0):.0f} s at most"
    row = (_cases(found), settings["seed"], settings.get("commit", ""), took, command)
    return "## How the results were made\n\n" + _table(("cases", "seed", "commit", "time of a case", "command"), [row])


def _table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    names = list(head)
    lines = [names, ["---"] * len(names), *([str(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _figures(figures: list[Json], by_sensor: dict[str, list[Json]]) -> str:
    def value(row: Json) -> str:
        if row["value"] is None:
            return "no cases"
        if "interval" in row:
            low, high = row["interval"]
            return f"{100 * row['value']:.1f} % ({row['successes']} of {row['count']}; 95 %: {100 * low:.0f}-{100 * high:.0f})"
        return f"{100 * row['value']:.1f} % (of {row['count']})" if row["percent"] else f"{row['value']:g} (of {row['count']})"

    reached = {"yes": "yes", "no": "**no**", "undecided": "undecided", None: ""}

    def cell(row: Json) -> str:
        said = reached[row["reached"]]
        return f"{value(row)}, {said}" if said else value(row)

    shown = {_SENSORS[sensor]: rows for sensor, rows in by_sensor.items() if rows[-1]["count"]}
    columns = {"both sensors": figures, **shown} if len(shown) > 1 else shown
    lines = zip(*columns.values(), strict=True)
    return _table(
        ("what", "goal", *columns),
        ((_LABELS.get(each[0]["what"], each[0]["what"]), each[0]["goal"], *map(cell, each)) for each in lines),
    )


def _baselines(found: Json) -> str:
    figures = {row["what"]: row for row in found["figures"]}
    ours = [
        figures[what] for what in list(figures) if what.startswith(("false alarms", "real change", "right class", "wrong names"))
    ]
    order = sorted(ours, key=lambda row: ("false", "real ", "right", "wrong").index(row["what"][:5]))
    rows = [("scarpsim gap", *(f"{row['successes']} of {row['count']}" for row in order))]
    for name, label in (("largest_z", "largest abs(z)"), ("plain_bic", "plain BIC")):
        values = found["baselines"][name]
        cells = (values[key] for key in ("false_alarms", "change_blamed", "right", "wrong_names"))
        rows.append((label, *(f"{hits} of {count}" for hits, count in cells)))
    head = ("method", "false alarms", "false alarms where only rock fell", "clear effects in the right class", "wrong names")
    return _table(head, rows)


def _by_effect(counts: Json) -> str:
    rows = []
    for key, answers in counts.items():
        cells = []
        for name in _ANSWERS:
            clear, weak, plain = (answers.get(f"{prefix}{name}", 0) for prefix in ("clear: ", "weak: ", ""))
            cells.append(f"{clear or ''}{f' (+{weak} weak)' if weak else ''}{plain or ''}".strip())
        rows.append((key, *cells))
    return _table(("truth", *_ANSWERS), rows)


def _curves(detection: Json) -> str:
    rows = []
    for sensor, bins in detection.items():
        if not any(row["cases"] or row["cases_by_angle"] for row in bins):
            continue
        for row in bins:
            upper = "" if row["to"] is None else f"{row['to']:g}"
            rows.append(
                (
                    sensor,
                    f"{row['from']:g}-{upper}",
                    f"{row['detected']} of {row['cases']}",
                    f"{row['right']} of {row['cases_by_angle']}",
                )
            )
    return _table(("sensor", "bin", "found at all", "right class"), rows)


def _coverage(coverage: Json) -> str:
    return _table(("parameter", "inside", "of"), ((key, row["inside"], row["count"]) for key, row in coverage.items()))


def _failures(failures: list[Json]) -> str:
    rows = (
        (
            f["case"],
            f["sensor"],
            f["stratum"],
            f["wrong"],
            "; ".join(f["true"]),
            f"{f['verdict']}: {'; '.join(f['said']) or 'nothing named'}" + _last(f["error"]),
        )
        for f in sorted(failures, key=lambda f: (f["wrong"], f["sensor"]))
    )
    return _table(("case", "sensor", "effects", "what is wrong", "truth", "answer"), rows)


def _last(error: str) -> str:
    return " ".join(error.strip().splitlines()[-1:]).replace("|", "/")

"""The results as a page of the documentation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

Json = dict[str, Any]
_PAGE = "docs/validation/gap_challenge.md"
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

_ALWAYS = """Always on: a pose off by millimetres and some 10 microradians; an error of the reference of 0.2-0.8 mm (stereo 1-4
mm), correlated over 1.5-6 m; albedo that varies smoothly and from point to point; 1-2 % of the returns missing, in a third of the
cases shrubs (round patches without returns); fallen blocks and debris in all strata but `none`; optional fields absent in a
quarter of the cases each; in one of eight laser cases an effect that the model has right already. Magnitudes: S/N, or S/N x
sin(angle), from 2 to 120, even in its logarithm, where no more than three times the catalogue's largest typical size gives it."""


_UNDECIDED = "undecided: the 95 % interval holds values that reach the goal and values that do not."


def markdown(found: Json) -> str:
    """docs/validation/gap_challenge.md, from results.json."""
    parts = [
        "# The challenge of the missing effect",
        f"{len(found['rows'])} measurements with hidden truth, made by `benchmarks/gap_challenge`, which shares no code with the "
        "sensors or the diagnosis, each diagnosed by `scarpsim gap`. S/N: of the effect's signature after the pose fit, against "
        "noise and the reference's correlated error; x sin(angle): what is left of it when the nearest "
        "effect of another class is fitted too (signatures with sin < 0.1 make one class).",
        _ALWAYS,
        _figures(found["figures"], found["by_sensor"]),
        _UNDECIDED,
        _command(found["settings"]),
        f"A case took {found['seconds'].get('median', 0):.0f} s (median), {found['seconds'].get('longest', 0):.0f} s at most.",
        "## Beside two baselines\n\nBoth take residuals for independent and give one name: the effect with the largest |z| above "
        "3, and the best by BIC if by more than 10.\n\n" + _baselines(found),
        "## What was answered\n\nclear: S/N x sin(angle) of 8 or more; weak: less.\n\n" + _by_effect(found["by_effect"]),
        "## Detection\n\nSingle effects: found at all by S/N; right class by S/N x sin(angle).\n\n" + _curves(found["detection"]),
        "## Coverage of the 90 % intervals\n\n" + _coverage(found["coverage"]),
        "## All failures\n\n" + _failures(found["failures"]),
    ]
    return "\n\n".join(parts) + "\n"


def _command(settings: Json) -> str:
    words = f"python benchmarks/gap_challenge/run.py --cases {settings['cases']} --seed {settings['seed']}"
    chosen = "".join(f" --{key} {settings[key]}" for key in ("stratum", "sensor") if key in settings)
    return f"From `{words}{chosen}{' --small' if settings['small'] else ''} --jobs 2 --out DIR --table {_PAGE}`."


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

    head = ("what", "to reach", "both sensors", "laser", "stereo")
    columns = zip(figures, by_sensor["tls"], by_sensor["stereo"], strict=True)
    return _table(head, ((each[0]["what"], each[0]["goal"], *map(cell, each)) for each in columns))


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
    return _table(("", "false alarms", "change blamed", "right class, clear", "wrong names among committed"), rows)


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
            f"{f['verdict']}: {'; '.join(f['said'])}" + _last(f["error"]),
        )
        for f in sorted(failures, key=lambda f: (f["wrong"], f["sensor"]))
    )
    return _table(("case", "sensor", "stratum", "wrong", "truth", "answer"), rows)


def _last(error: str) -> str:
    return " ".join(error.strip().splitlines()[-1:]).replace("|", "/")

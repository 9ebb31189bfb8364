"""Write the table of injections as a page of the documentation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from benchmarks.gap_injections.bases import BASES
from benchmarks.gap_injections.score import SIZES, Json

_KINDS = ("right", "class", "described", "size", "missed", "wrong", "refused", "error")
_CLEAR, _STRONG = 8.0, 30.0

_HEAD = """# Known effects put into real scans

This page shows whether `scarpsim gap` names a known effect in a real measurement. Real measurements disagree with their model in
ways that no generator makes: edges, twigs, relief between points, rounded coordinates. The page is for users who want to know
what to expect from data of their own. The [closed-form generator](gap_closed_form.md) tests the same on simulated measurements.

Each case begins with one of eight real measurements. A known effect is added to its ranges, angles or disparities by a formula
that shares no code with the program (`benchmarks/gap_injections/formulas.py`). The result is diagnosed as by `scarpsim gap`. This
command makes the page:

    OMP_NUM_THREADS=1 python benchmarks/gap_injections/run.py --out /tmp/injections --page docs/validation/gap_injections.md"""

_OUTCOMES = {
    "right": "names the effect with its size, and no other new effect",
    "class": "does not name the effect, but lists it among those that cannot be told from a named one; names no other new effect",
    "described": "has the effect with its size, but as an empirical term; names no new effect",
    "size": "names the effect with a wrong size, and no other new effect",
    "missed": "neither names nor lists the effect, and names no new effect",
    "wrong": "names at least one new effect that is neither the injected one nor lists it, even if the injected one is named too",
    "refused": "is an error message of the program",
    "error": "is a failure of the program",
}
"""What each judgement means."""

_RULES = """These rules apply:

- **Named** counts effects of the [catalogue](../reference/effects/README.md). An empirical term, which describes a pattern
  without a cause, is in the column "named" of the tables, but does not count. Some carry "empirical" in their name. Others
  have the name of a noise effect.
- **New** is an effect that no diagnosis of the measurement without the injection names, or lists among those that cannot be
  told from a named one (there are two diagnoses, see below). Such effects may stand beside the injected one.
- **The size is right** within 3 standard errors or 15 % of the injected value, and the period of a wave within 5 %. Other
  parameters are not checked.
- **What the measurement lacks before** adds to the injection, and that sum is right too. An effect that the diagnosis names
  without the injection adds to an injected one of the same name. Noise adds as variance: the residuals before may scatter more
  or less than the model predicts. A noise that falls with the intensity is compared at an intensity of 201.
- **The verdict** does not count for effects of the catalogue.
- **Errors outside the catalogue** (`off_...`) are *right* if the verdict is `unknown` and no new effect is named, *wrong* if
  a new effect is named, and *missed* otherwise."""

_OUTSIDE = {
    "`off_jump`": "all ranges in the second half of the azimuths are longer by the size",
    "`off_facets`": "the ranges of every fourth scan line are longer by the size, as from one facet of a mirror",
    "`off_saddle`": "the error is proportional to the product of the two coordinates of the scan or image, up to the size",
    "`off_column_banding`": "disparities alternate by plus and minus half of the size between bands of columns",
}
"""The errors outside the catalogue."""

_STRENGTH = (
    "S/N is the signal-to-noise ratio of the change that the effect makes to all residuals together, after a shift and a "
    "rotation of the sensor are fitted. The noise is taken as independent between points. For systematic effects its standard "
    "deviation is the scatter of the measurement itself. For noise effects S/N is the change of the variance over its standard "
    "error. Neighbours share real errors, so the true ratio is smaller."
)

_COLUMNS = (
    'The first column has the number of the case. "Put in" is the injected effect, and "values" are its parameters. The end '
    "of each name "
    'of a value is its unit (m, rad, px, ppm); k1 has none. "Outcome" is explained above, "verdict" on [the pages of the '
    'verdicts](../reference/gap/unknown.md). "Named" is what the answer names. "Size found" is the injected effect\'s size in '
    "the "
    "answer with its standard error."
)

_BASES_READ = (
    "An answer is a [verdict](../reference/glossary.md#model-and-measurement), with the effects that it names after a "
    'colon. "Before" says how far the residuals are from those that the model predicts without named effects, and "floor" '
    'what noise alone leaves ([score](../explanation/gap_verdict.md#the-gap)). "One half against the other" means that '
    "every second point makes the reference surface with which the others are compared. The scans disagree with the noise "
    "of the data sheet, so the injections start from the noise that the first answer proposes."
)

_CAUSES = {
    "ground of the forest, noise of 1 and 2 mm": (
        "the relief between the points of the reference is as large as the noise (2.3 mm), and counts as [the reference's "
        "error](../explanation/how_gap_works.md#references-made-of-points)"
    ),
    "effects above ten times the typical size (on the effect's page) that a shift or rotation of the sensor nearly imitates": (
        "they are not searched for, on purpose; the effect that is named in their place lists them as alternatives"
    ),
    "angle noise of 1 mrad": (
        "it moves points beyond their triangle of the reference, and noise that depends on the incidence is named beside it"
    ),
    "`trees`, a constant offset": "an error of an angle describes a part of it, and is named beside a smaller offset",
    "`rocks`": (
        "the residuals scatter 1.9 times as much as the model predicts, and neighbours share half of that (relief, coordinates "
        "rounded to 6 cm); the scan has an intensity bias of -0.011 m of its own, which nearly cancels the one of case 44, and "
        "probably an incidence bias of -0.02 m"
    ),
    "`light`, effects of hundredths of a pixel, and what is left of larger ones": (
        "its noise is 0.009 px with 3 % outliers, and it disagrees with its model by some thousandths of a pixel before; "
        "camera effects of that size are named"
    ),
    "`light`, smoothing": (
        "it is found with its width, but dropped: a few points beside edges lie farther off with it, and outweigh the others on "
        "the validation blocks"
    ),
    "`light`, row_jitter": (
        "the data's own disagreement with their model passes for overtones of the jitter, which is 20 times their noise, and a "
        "sine with overtones gets no name; the last digits of the estimated pose decide"
    ),
    "`matcher`": (
        "which effect is named before the injection depends on single points: `affinity_skew` here, edge fattening and a focal "
        "length with one usable point less; beside what was named, a distortion of a smaller size fits"
    ),
}
"""Where cases fail, and why."""

_DISPARITIES = ("light", "matcher")


def page(rows: list[Json], bases: dict[str, Json]) -> str:
    """docs/validation/gap_injections.md."""
    failed = [row for row in rows if row["judgement"] not in ("right", "class")]
    parts = [
        _HEAD,
        "## Results\n\n" + _in_short(rows) + "\n\n" + _counts(rows),
        "## How answers are scored\n\n" + _table(("outcome", "the answer"), _OUTCOMES.items()),
        _RULES,
        _table(("error outside the catalogue", "what it is"), _OUTSIDE.items()),
        _STRENGTH,
        f"## The measurements without an injected effect\n\n{_BASES_READ}\n\n" + _bases(bases),
        "## Why cases fail\n\n" + _table(("where", "why"), _CAUSES.items()),
        f"## Failures\n\nThese are {len(failed)} of {len(rows)} cases. {_COLUMNS}\n\n" + _rows(failed),
        "## All injections\n\n" + _rows(rows),
    ]
    return "\n\n".join(parts) + "\n"


def _table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    names = list(head)
    lines = [names, ["---"] * len(names), *([str(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _bases(bases: dict[str, Json]) -> str:
    rows = []
    for name in [each for each in BASES if each in bases]:
        found = bases[name]
        last = found.get("as_diagnosed", found["as_it_is"])
        rows.append([f"`{name}`", BASES[name].about, f"{last['points']:,}", _verdict(found["as_it_is"]), _base_words(found)])
    return _table(
        (
            "name",
            "content",
            "points",
            "answer with the noise of the data sheet",
            "answer with the noise that the first answer proposes, which is used below",
        ),
        rows,
    )


def _base_words(found: Json) -> str:
    if "as_diagnosed" not in found:
        return "no other noise proposed: as it is"
    noise = ", ".join(f"{key} {value:.3g}" for key, value in found["noise"].items())
    return f"{noise}: {_verdict(found['as_diagnosed'])}"


def _verdict(said: Json) -> str:
    names = ", ".join(each["name"].partition(".")[2] for each in said["effects"])
    gap = said.get("gap")
    figures = "" if gap is None else f" ({1e3 * gap['before']:.2g} mm before, {1e3 * gap['floor']:.2g} mm floor)"
    return f"{said['verdict']}{': ' + names if names else ''}{figures}"


def _counts(rows: list[Json]) -> str:
    groups: list[tuple[str, list[Json]]] = [("all", rows)]
    groups.append((f"S/N {_STRONG:g} and more", [row for row in rows if (row["strength"] or 0) >= _STRONG]))
    groups.append((f"S/N {_CLEAR:g} to {_STRONG:g}", [row for row in rows if _CLEAR <= (row["strength"] or 0) < _STRONG]))
    groups.append((f"S/N below {_CLEAR:g}", [row for row in rows if (row["strength"] or 0) < _CLEAR]))
    groups += [(f"`{base}`", [row for row in rows if row["base"] == base]) for base in dict.fromkeys(row["base"] for row in rows)]
    lines = []
    for name, group in groups:
        kinds = Counter(row["judgement"] for row in group)
        lines.append([name, len(group), *(kinds.get(kind, 0) for kind in _KINDS)])
    return _table(("injections", "number", *_KINDS), lines)


def _in_short(rows: list[Json]) -> str:
    """Summarise the counts in a table and in sentences."""
    good = [row for row in rows if row["judgement"] in ("right", "class")]
    known = [row for row in good if not row["effect"].startswith("off_")]
    spoiled = [row for row in known if row["verdict"] == "unknown"]
    said = [
        "| measurements | effects of the catalogue that are named with their size, or listed among those that cannot be told "
        "from a named one | errors outside the catalogue with the right answer, `unknown` | a wrong effect is named, all cases |",
        "| --- | --- | --- | --- |",
    ]
    for words, on_disparities in (("laser scans", False), ("disparities", True)):
        group = [row for row in rows if (row["base"] in _DISPARITIES) is on_disparities]
        outside = [row for row in group if row["effect"].startswith("off_")]
        inside = [row for row in group if row not in outside]
        right, unknown = (sum(row in good for row in part) for part in (inside, outside))
        wrong = sum(row["judgement"] == "wrong" for row in group)
        said.append(f"| {words} | {right} of {len(inside)} | {unknown} of {len(outside)} | {wrong} of {len(group)} |")
    said.append(
        "\nFor simulated measurements the goal is to name a wrong effect in 2 % of the cases at most. "
        f"In {len(spoiled)} of the {len(known)} good answers on effects of the catalogue the verdict is still `unknown`, because "
        "the measurement disagrees with its model even without the injection.\n\nIn the next table each row is a group of "
        'injections: by their signal-to-noise ratio S/N, or by the measurement (both are explained below). "Number" is the '
        "size of the group, and the other columns count [the outcomes](#how-answers-are-scored). Right and class are good "
        "outcomes."
    )
    return "\n".join(said)


def _rows(rows: list[Json]) -> str:
    lines = [
        [
            row["number"],
            f"`{row['base']}`",
            row["effect"],
            _values(row["values"]),
            "" if row["strength"] is None else f"{row['strength']:.3g}",
            row["judgement"],
            row["verdict"],
            ", ".join(row["named"]) or "nothing",
            _found(row),
        ]
        for row in rows
    ]
    return _table(("", "measurement", "put in", "values", "S/N", "outcome", "verdict", "named", "size found"), lines)


def _values(values: Json) -> str:
    return ", ".join(f"{key} {value:g}" for key, value in values.items())


def _found(row: Json) -> str:
    found = row["found"]
    if found is None:
        return ""
    error = "" if found["std"] is None else f" ± {found['std']:.2g}"
    return f"{SIZES[row['effect']]} {found['value']:.3g}{error}"

"""Write the files of an identifiability analysis.

They are identifiability.json, report.html and a figure of the matrix for each sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.formats.files.atomic import write_json, write_text, writing
from pipeline.gap.report.figures import matrix_figure
from pipeline.gap.report.wording import format_number, join_words
from pipeline.gap.survey.identifiability import NAMING_SNR, SIMILAR_COSINE, Identifiability
from pipeline.gap.survey.survey_design import DETECTION_SNR, REFERENCE_LENGTH_M
from pipeline.report.page import template
from pipeline.report.provenance import versions

_INSTRUMENTS = {"stereo": "Stereo pair", "tls": "Laser scanner"}
_WORTHWHILE_RATIO = 0.8
"""An additional measurement is shown if it lowers the size from which an effect can be named to this share."""


def write_identifiability(out: Path, found: Sequence[Identifiability]) -> Path:
    """Write the report on which sensor errors a planned survey can detect and tell apart.

    Its files are report.html, identifiability.json and a figure for each sensor.

    Parameters
    ----------
    out : folder to write.
    found : one analysis of the survey for each sensor.

    Returns
    -------
    Path : path of report.html.
    """
    record = {"schema": 1, "surveys": [each.to_dict() for each in found], "versions": versions()}
    write_json(out / "identifiability.json", record)
    pictures = {each.sensor: matrix_figure(list(each.names), each.cosines, each.survival) for each in found}
    for sensor, picture in pictures.items():
        with writing(out / f"identifiability_{sensor}.png") as temporary:
            temporary.write_bytes(picture)
    page = template("gap/report/identifiability.html.jinja").render(
        parts=[_part(each, pictures[each.sensor]) for each in found],
        alike=SIMILAR_COSINE,
        seen_at=DETECTION_SNR,
        named_at=NAMING_SNR,
        length_m=REFERENCE_LENGTH_M,
    )
    write_text(out / "report.html", page)
    return out / "report.html"


def summarise(found: Identifiability) -> str:
    """Return a paragraph for the terminal on which sensor errors a planned survey can tell apart.

    It names the errors that a shift or rotation of the sensor imitates, the pairs that look alike, and the further measurement
    that separates most pairs. found: the analysis of the survey for one sensor.
    """
    weak = [name for name, share in zip(found.names, found.survival, strict=True) if share < 0.1]
    pairs = found.similar_pairs()
    parts = [f"{_INSTRUMENTS[found.sensor]}, {found.points:,} points on smooth parts of the wall."]
    if weak:
        parts.append(f"A shift or rotation of the sensor absorbs more than 90 % of {join_words(weak)}.")
    if pairs:
        a, b = pairs[0]
        parts.append(
            f"{len(pairs)} pairs of effects look alike (cosine of at least {SIMILAR_COSINE:g}), most of all {found.names[a]} and"
            f" {found.names[b]} ({found.cosines[a, b]:.3f}): this survey alone cannot tell the two apart."
        )
        counts = {e.name: sum(bool(e.cosines[pair] < SIMILAR_COSINE) for pair in pairs) for e in found.extensions}
        best = max(counts, key=lambda name: counts[name])
        verb = f"would separate {counts[best]} of the {len(pairs)}" if counts[best] else "would separate any of them"
        parts.append(f"{'None of the further measurements' if not counts[best] else best.capitalize()} {verb}.")
    else:
        parts.append("No two systematic effects look alike.")
    return " ".join(parts)


def _part(found: Identifiability, picture: bytes) -> dict[str, Any]:
    """What the template shows of one analysis."""
    return {
        "instrument": _INSTRUMENTS[found.sensor],
        "words": summarise(found),
        "picture": picture,
        "rows": [_row(found, row) for row in range(len(found.names))],
        "extensions": [extension.name for extension in found.extensions],
        "pairs": [
            (found.names[a], found.names[b], found.cosines[a, b], [e.cosines[a, b] for e in found.extensions])
            for a, b in found.similar_pairs()
        ],
        "others": [(each, _format_value(each.parameter, each.detectable_size)) for each in found.others],
        "reference_error_m": found.reference_error_m,
    }


def _row(found: Identifiability, row: int) -> dict[str, str]:
    """The row of one effect in the page's table of effects."""
    best, named = found.best_extension(row), found.nameable_size[row]
    helps = best.nameable_size[row] < _WORTHWHILE_RATIO * named
    alike = (f"{found.names[other].partition('.')[2]} {found.cosines[row, other]:.2f}" for other in found.similar_effects(row))
    return {
        "name": found.names[row] + (f" ({found.variants[row]})" if found.variants[row] else ""),
        "parameter": found.parameters[row],
        "survival": f"{100 * found.survival[row]:.1f} %",
        "detectable_size": _format_value("", found.detectable_size[row]),
        "nameable_size": _format_value("", named),
        "alike": ", ".join(alike),
        "extension": f"{_format_value('', best.nameable_size[row])} with {best.name}" if helps else "",
    }


def _format_value(parameter: str, value: float) -> str:
    """Format a parameter's value; "never" where it is infinite."""
    return f"{parameter} {format_number(value, 2) if np.isfinite(value) else 'never'}".strip()

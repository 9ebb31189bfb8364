"""Say what a diagnosis could not have seen: the detectable size of each effect that was not named."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.gap.mean.detection_power import POWER, DetectableSize
from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.report.quantities import format_with_std
from pipeline.gap.survey.identifiability import REFERENCE_ERRORS_M
from sensors.effects import EFFECTS, effect_of

_MOST_NAMED = 4
"""Effects that the line in the terminal lists."""
_UNUSUAL = 3.0
"""An error of the reference is unusual if it is more than this many times the usual one."""
_OBSERVABLE = {"tls": "smooth_m", "stereo": "smooth_px"}
"""A key with the unit of each sensor's observable."""


def unseen_entry(found: GapDiagnosis) -> list[dict[str, Any]]:
    """Return the entry `detectable` of gap.json: sensor errors that were not found, and the size that would have shown."""
    return [{**each.to_dict(), "name": _full_name(each, found.residuals.sensor)} for each in found.unseen]


def unseen_rows(found: GapDiagnosis) -> list[dict[str, str]]:
    """Return the rows of the report's table of sensor errors that may be there although the diagnosis did not name them.

    Each has `name`; `size`, from which it would have shown with a probability of 95 %; and `note`: the period or camera for
    which the size holds, or why there is no size.
    """
    return [
        {
            "name": _full_name(each, found.residuals.sensor),
            "size": f"{each.parameter} {_format(each, found.residuals.sensor)}".strip(),
            "note": each.note or ", ".join(f"{key} {_short(value)}" for key, value in each.at.items()),
        }
        for each in found.unseen
    ]


def unseen_line(found: GapDiagnosis) -> str:
    """Return a line for the terminal on sensor errors that may be there unseen, with the size from which they would have shown.

    It names four errors: those whose size is largest relative to what instruments commonly have. It is "" if no size is known.
    """
    sensor = found.residuals.sensor
    known = [each for each in found.unseen if np.isfinite(each.size) and each.parameter]
    if not known:
        return ""
    typical = {each.name: effect_of(each.name).typical_sizes() for each in known}
    largest = sorted(known, key=lambda each: -each.size / typical[each.name].get(each.parameter, 1.0))[:_MOST_NAMED]
    named = ", ".join(f"{each.name} {_format(each, sensor)}" for each in largest)
    more = f"; {len(known) - len(largest)} more in report.html" if len(known) > len(largest) else ""
    return f"smaller effects than these may be hidden ({100 * POWER:.0f} % would have shown): {named}{more}"


def reference_line(found: GapDiagnosis) -> str:
    """Return a warning if the reference surface is unusually inaccurate, because this hides sensor errors that look alike.

    The warning is given if the standard deviation of its error, as estimated, is over 3 mm (laser scanner) or 15 mm (stereo);
    otherwise the text is "".
    """
    if not len(found.residuals) or not found.reference_sigma:
        return ""
    error_m = found.reference_sigma * float(np.median(found.residuals.unit_m))
    usual_m = REFERENCE_ERRORS_M[found.residuals.sensor]
    if error_m <= _UNUSUAL * usual_m:
        return ""
    return (
        f"the reference seems to err by {1e3 * error_m:.2g} mm (standard deviation, correlated over metres), more than the usual "
        f"{1e3 * usual_m:.2g} mm, and what looks like that is hidden. If the reference is better, give its error with "
        "--reference-error; if not, use a better one"
    )


def _full_name(item: DetectableSize, sensor: str) -> str:
    """The name with the sensor as prefix; that of an error outside the catalogue as it is."""
    return f"{sensor}.{item.name}" if any(effect.tag() == item.name for effect in EFFECTS) else item.name


def _format(item: DetectableSize, sensor: str) -> str:
    """The size with its unit, to two digits; a dash where there is none."""
    if not np.isfinite(item.size):
        return "\N{EN DASH}"
    return format_with_std(item.parameter or _OBSERVABLE[sensor], float(f"{item.size:.2g}"))


def _short(value: float | str) -> str:
    """Format a period, or name a camera, for which a detectable size holds."""
    return value if isinstance(value, str) else f"{value:.3g}"

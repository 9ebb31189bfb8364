"""The form in which `thresholds.py` and `noise_thresholds.py` declare a threshold: value, unit, what it decides, source."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

DEVELOPMENT, JUDGEMENT = "development cases", "judgement"
"""Sources of values: tuned on the development cases of the closed-form generator, or chosen by the authors."""


class ThresholdGroup(BaseModel):
    """Base class of a group of thresholds of `gap`: values cannot change; unknown keys, infinities and NaN are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def threshold_field(default: float, unit: str, decides: str, source: str, **bounds: Any) -> Any:
    """Declare one threshold of `gap` as a pydantic field, with its documentation.

    Parameters
    ----------
    default : default value.
    unit : unit of the value, in words.
    decides : what the threshold decides, in whole sentences.
    source : where the value comes from, in words, such as "judgement".
    bounds : limits on the value, as keyword arguments of `pydantic.Field`, such as `lt=1`.

    Returns
    -------
    The pydantic field, as the default value of a class attribute.
    """
    return Field(default, description=decides, json_schema_extra={"unit": unit, "source": source}, **bounds)

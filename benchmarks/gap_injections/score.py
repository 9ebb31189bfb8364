"""Score an answer: which names, sizes and rejections are right."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Json = dict[str, Any]
SIZES = {
    "range_offset": "offset_m", "range_scale": "scale_ppm", "range_cyclic": "amplitude_m",
    "range_incidence_bias": "coefficient_m",
    "range_intensity_bias": "coefficient_m", "range_quantization": "step_m", "range_noise": "sigma_m",
    "range_noise_proportional": "ppm", "range_noise_incidence": "sigma_m", "range_noise_intensity": "a_m",
    "vertical_index": "offset_rad", "vertical_eccentricity": "amplitude_rad", "horizontal_eccentricity": "amplitude_rad",
    "collimation": "angle_rad", "trunnion_tilt": "angle_rad", "wobble": "amplitude_rad", "angle_noise": "zenith_sigma_rad",
    "principal_point_x": "delta_px", "focal_length": "delta_px", "radial_distortion": "k1", "row_jitter": "amplitude_px",
    "pixel_locking": "amplitude_px", "parallax_noise": "sigma_px", "regularization_noise": "sigma_px", "smoothing": "sigma_px",
    "edge_fattening": "radius_px",
}  # fmt: skip
"""Parameter that states an effect's size."""
INTENSITY = 201.0
"""Intensity at which the sizes of a noise are compared if it depends on the intensity by a fitted exponent."""
_SIGMAS, _SHARE = 3.0, 0.15


@dataclass(frozen=True)
class BeforeInjection:
    """Effects and noise that a measurement had before an effect was injected.

    Attributes
    ----------
    effects : effects of the catalogue that its diagnosis names, as in gap.json, by name without the sensor.
    missing_noise : factor on the size of an injected noise that makes up for what the model has too much or too little before.
    """

    effects: Mapping[str, Json] = field(default_factory=dict)
    missing_noise: float = 1.0

    @property
    def possible(self) -> set[str]:
        """Names of these effects and of those that the diagnosis cannot tell from them."""
        alike = (_bare(name) for each in self.effects.values() for name in each["cannot_be_told_from"])
        return {*self.effects, *alike}


_QUIET = BeforeInjection()


def scored(answer: Json, before: BeforeInjection = _QUIET) -> Json:
    """Return a row of the table with the judgement of an answer.

    The judgement is one of: right (named, with the injected size, and nothing else blamed); class (among effects that cannot be
    told apart); size (named, with another size); wrong (another effect is blamed, in addition or alone); missed (no effect of the
    catalogue is named); described (the effect is found with its size, but as an empirical term); refused. Outside the catalogue,
    an answer without a name is right.

    before: the measurement without the injection; its effects do not count as wrong, and add to an injected one of their name.
    """
    case = answer["case"]
    effect, said = case["effect"], answer["effects"]
    physical = [each for each in said if each["kind"] == "physical"]
    own = next((each for each in physical if _bare(each["name"]) == effect), None)
    alike = any(effect in map(_bare, each["cannot_be_told_from"]) for each in physical)
    new = [each for each in physical if _bare(each["name"]) not in before.possible]
    others = [each for each in new if each is not own and effect not in map(_bare, each["cannot_be_told_from"])]
    return {
        "number": case["number"],
        "base": case["base"],
        "effect": effect,
        "values": case["values"],
        "strength": answer["strength"],
        "verdict": answer["verdict"],
        "named": [_bare(each["name"]) for each in said],
        "found": next((_size(each, effect) for each in said if _bare(each["name"]) == effect), None),
        "judgement": _judgement(answer, own, alike, others, before),
        "gap": answer.get("gap"),
        "cpu_s": answer.get("cpu_s"),
    }


def _judgement(answer: Json, own: Json | None, alike: bool, others: list[Json], before: BeforeInjection) -> str:
    effect = answer["case"]["effect"]
    if answer["verdict"] in ("refused", "error"):
        return answer["verdict"]
    if others:
        return "wrong"
    if effect.startswith("off_"):
        return "right" if answer["verdict"] == "unknown" else "missed"
    if own is None:
        described = [each for each in answer["effects"] if _bare(each["name"]) == effect]
        if described and _of_size(described[0], answer["case"], before):
            return "described"
        return "class" if alike else "missed"
    return "right" if _of_size(own, answer["case"], before) else "size"


def _bare(name: str) -> str:
    return name.partition(".")[2] or name


def _size(said: Json, effect: str) -> Json:
    return said["parameters"][SIZES[effect]]


def _of_size(said: Json, case: Json, before: BeforeInjection) -> bool:
    """Whether the size is within three standard errors or 15 % of a right one, and a period within 5 %."""
    effect, values = case["effect"], case["values"]
    size, std = _signed(said, effect), _size(said, effect)["std"] or 0.0
    right = [values[SIZES[effect]] * _at_intensity(values)]
    if "noise" in effect:
        right.append(right[0] * before.missing_noise)
    elif effect in before.effects and not SIZES[effect].startswith("amplitude"):
        right.append(right[0] + _signed(before.effects[effect], effect))
    near = any(abs(size - each) <= max(_SIGMAS * std, _SHARE * abs(each)) for each in right)
    periods = [key for key in ("period_m", "lines_per_cycle", "rows_per_cycle") if key in values]
    return near and all(math.isclose(said["parameters"][key]["value"], values[key], rel_tol=0.05) for key in periods)


def _signed(said: Json, effect: str) -> float:
    """Size as if the left camera had it, and a noise that falls with the intensity at `INTENSITY`."""
    parameters = {key: each["value"] for key, each in said["parameters"].items() if isinstance(each, dict)}
    size = parameters[SIZES[effect]] * _at_intensity(parameters)
    # the other camera the other way is the same disparity; of a wave that is its phase
    turned = parameters.get("camera") == "right" and not SIZES[effect].startswith("amplitude")
    return float(-size if turned else size)


def _at_intensity(values: Json) -> float:
    """Factor between a noise's parameter and its standard deviation at `INTENSITY`; 1 for other effects."""
    return float(INTENSITY ** values.get("exponent", 0.0))

"""Score an answer: which names, sizes and rejections are right."""

from __future__ import annotations

import math
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
_SIGMAS, _SHARE = 3.0, 0.15


def scored(answer: Json, before: frozenset[str] = frozenset()) -> Json:
    """Return a row of the table with the judgement of an answer.

    The judgement is one of: right (named, with the injected size, and nothing else blamed); class (among effects that cannot be
    told apart); size (named, with another size); wrong (another effect is blamed, in addition or alone); missed (no effect of the
    catalogue is named); described (the effect is found with its size, but as an empirical term); refused. Outside the catalogue,
    an answer without a name is right.

    before: effects that the measurement is said to have without an injection, which do not count as wrong.
    """
    case = answer["case"]
    effect, said = case["effect"], answer["effects"]
    physical = [each for each in said if each["kind"] == "physical"]
    own = next((each for each in physical if _bare(each["name"]) == effect), None)
    alike = any(effect in map(_bare, each["cannot_be_told_from"]) for each in physical)
    new = [each for each in physical if _bare(each["name"]) not in before]
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
        "judgement": _judgement(answer, effect, own, alike, others),
        "gap": answer.get("gap"),
        "cpu_s": answer.get("cpu_s"),
    }


def _judgement(answer: Json, effect: str, own: Json | None, alike: bool, others: list[Json]) -> str:
    if answer["verdict"] in ("refused", "error"):
        return answer["verdict"]
    if others:
        return "wrong"
    if effect.startswith("off_"):
        return "right" if answer["verdict"] == "unknown" else "missed"
    if own is None:
        described = [each for each in answer["effects"] if _bare(each["name"]) == effect]
        if described and _of_size(described[0], effect, answer["case"]["values"]):
            return "described"
        return "class" if alike else "missed"
    return "right" if _of_size(own, effect, answer["case"]["values"]) else "size"


def _bare(name: str) -> str:
    return name.partition(".")[2] or name


def _size(said: Json, effect: str) -> Json:
    return said["parameters"][SIZES[effect]]


def _of_size(said: Json, effect: str, values: Json) -> bool:
    """Whether the size is within three standard errors or 15 % of the injected one, and a period within 5 %."""
    size, true = _size(said, effect), values[SIZES[effect]]
    # the other camera the other way is the same disparity; of a wave that is its phase
    turned = said["parameters"].get("camera", {}).get("value") == "right" and not SIZES[effect].startswith("amplitude")
    off = abs((-size["value"] if turned else size["value"]) - true)
    near = off <= max(_SIGMAS * (size["std"] or 0.0), _SHARE * abs(true))
    periods = [key for key in ("period_m", "lines_per_cycle", "rows_per_cycle") if key in values]
    return near and all(math.isclose(said["parameters"][key]["value"], values[key], rel_tol=0.05) for key in periods)

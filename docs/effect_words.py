"""Words that the pages of the effects share: the stages of a sensor, and the symbols of the equations."""

from __future__ import annotations

import inspect
import re

from sensors.effects.base import Effect, Stage

STAGES = {
    Stage.AIM: "the effect changes the direction in which the beam leaves",
    Stage.FOOTPRINT: "the effect widens the beam into sub-rays and combines their echoes",
    Stage.RANGE: "the effect changes the recorded range",
    Stage.POWER: "the effect changes the received power",
    Stage.RETURN: "the effect removes or adds returns",
    Stage.CAMERA: "the effect makes the real cameras differ from the calibrated ones, with which depths are computed",
    Stage.EXPOSE: "the effect displaces the rows of an image",
    Stage.MATCH: "the effect changes the disparities that the matcher finds",
    Stage.FILL: "the effect fills cells of the depth map without a match",
    Stage.POINT: "the effect moves the recorded points",
}
_SYMBOLS: dict[str, tuple[tuple[str, str], ...]] = {
    "tls": (
        (r"dR\b", "dR: recorded minus true range, m"),
        (
            r"(?<![a-z])d?az\b|azimuth error",
            "az: azimuth, the angle about the vertical axis; daz: recorded minus true azimuth, rad",
        ),
        (r"\bd?z\b", "z: zenith angle, from the vertical down; dz: recorded minus true zenith angle, rad"),
        (r"\bR\b", "R: range, the distance from the scanner to the rock, m"),
        (r"cos i\b", "i: incidence angle between the beam and the normal of the surface, rad"),
        (r"\bI\b", "I: received power, relative to that of albedo 1 at 100 m and normal incidence"),
        (r"\brho\b", "rho: albedo, the share of the light that the rock reflects"),
        (r"\bc tau\b", "c: speed of light, m/s; tau: duration of the laser pulse, s"),
        (r"\bN\(", "N(0, s): normally distributed random error of mean 0 and standard deviation s"),
    ),
    "stereo": (
        (r"\bd\b|\bdd\b|isparit", "d: disparity; dd: recorded minus true disparity, px"),
        (
            r"_real\b",
            "_real: of the camera that takes the picture; _nominal: of its calibration or survey;"
            " the parameters are those of the [camera model](../../explanation/conventions.md#camera-model)",
        ),
        (r"\bR_", "R: rotation from camera to world axes"),
        (r"\bN\(", "N(0, s): normally distributed random error of mean 0 and standard deviation s"),
        (r"px|isparit", "px: pixels of the full-resolution image, even where the depth map has larger cells"),
    ),
}


def symbols(effect: type[Effect]) -> str:
    """Return a list of the symbols in the equation of an effect, in Markdown; empty if there are none."""
    text = inspect.cleandoc(effect.__doc__ or "")
    used = [meaning for pattern, meaning in _SYMBOLS[effect.sensor] if re.search(pattern, text)]
    return "\n".join(["Symbols:", "", *(f"- {meaning}" for meaning in used)]) if used else ""

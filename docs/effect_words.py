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
        (r"\ba (sin|cos)\b", "a: amplitude, see the parameters below"),
        (r"\bA sin\b", "A: amplitude, see the parameters below"),
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
        (r"\bd\b|\bd_|\bdd\b", "d: disparity, px"),
        (r"\bdd\b", "dd: recorded minus true disparity, px"),
        (r"\bsigma_d\b", "sigma_d: standard deviation of the disparity, px"),
        (r"\bA sin\b", "A: amplitude, see the parameters below"),
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


_REFERENCES = {
    "Lichti 2007": "Lichti (2007), Error modelling, calibration and analysis of an AM-CW terrestrial laser scanner system, ISPRS"
    " Journal of Photogrammetry and Remote Sensing 61(5); A0, B2 and so on are the names of its parameters",
    "NIST x": "NIST: Muralikrishnan et al. (2015), Volumetric performance evaluation of a laser scanner based on geometric error"
    " model, Precision Engineering 40; x4 and so on are the names of its parameters",
    "Soudarissanane et al. 2011": "Soudarissanane et al. (2011), Scanning geometry: influencing factor on the quality of"
    " terrestrial laser scanning points, ISPRS Journal of Photogrammetry and Remote Sensing 66(4)",
    "Wujanz et al. 2017": "Wujanz et al. (2017), An intensity-based stochastic model for terrestrial laser scanners, ISPRS"
    " Journal of Photogrammetry and Remote Sensing 125",
    "Schmitz et al. 2019": "Schmitz et al. (2019), How to efficiently determine the range precision of 3D terrestrial laser"
    " scanners, Sensors 19(6)",
    "Hirschmueller 2008": "Hirschmueller (2008), Stereo processing by semiglobal matching and mutual information, IEEE"
    " Transactions on Pattern Analysis and Machine Intelligence 30(2)",
    "Shimizu & Okutomi 2005": "Shimizu and Okutomi (2005), Sub-pixel estimation error cancellation on area-based matching,"
    " International Journal of Computer Vision 63(3)",
    "Knutsson & Westin 1993": "Knutsson and Westin (1993), Normalized and differential convolution, CVPR 1993",
    "James & Robson 2014": "James and Robson (2014), Mitigating systematic error in topographic models derived from UAV and"
    " ground-based image networks, Earth Surface Processes and Landforms 39(10)",
    "Metashape user manual": "Agisoft Metashape user manual, appendix D, Camera models",
}


def references(effect: type[Effect]) -> str:
    """Return the publications that the equation and the parameters of an effect name, in Markdown; empty if there are none."""
    extras = [info.json_schema_extra for info in effect.model_fields.values()]
    text = inspect.cleandoc(effect.__doc__ or "") + " ".join(
        str(extra.get("source", "")) for extra in extras if isinstance(extra, dict)
    )
    named = [title for key, title in _REFERENCES.items() if key in text]
    return "\n".join(["## References", "", *(f"- {title}" for title in named)]) if named else ""

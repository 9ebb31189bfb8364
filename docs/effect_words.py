"""Words that the pages of the effects share: the stages of a sensor, and the symbols of the equations."""

from __future__ import annotations

import inspect

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
_PARTS = {
    "dR": "dR: recorded minus true range, m",
    "R": "R: range, the distance from the scanner to the rock, m",
    "daz": "daz: recorded minus true azimuth (the angle about the vertical axis), rad",
    "az": "az: azimuth, the angle about the vertical axis, rad",
    "dz": "dz: recorded minus true zenith angle (from the vertical down), rad",
    "z": "z: zenith angle, from the vertical down, rad",
    "i": "i: incidence angle between the beam and the normal of the surface, rad",
    "I": "I: received power, relative to that of albedo 1 at 100 m and normal incidence",
    "N": "N(0, ...): normally distributed random error of mean 0; its standard deviation follows the comma",
    "d": "d: disparity, px",
    "dd": "dd: recorded minus true disparity, px",
    "d'": "d': disparity after the effect, px",
    "uv": "u, v: column and row of the pixel in the left image, px",
    "px": "px: pixels of the full-resolution image, even where the depth map has larger cells",
    "_real": "_real: of the camera that takes the picture; _nominal: of its calibration or survey. See the"
    " [camera model](../../explanation/conventions.md#camera-model)",
    "rotation": "R_real, R_nominal: rotation from camera to world axes",
    "sigma_px": "sigma: the parameter `sigma_px`",
    "phase": "phase: the parameter `phase_rad`",
}
"""Symbols that several equations share, by a short name."""

_SYMBOLS: dict[str, tuple[str, ...]] = {
    "angle_noise": (
        "aim: azimuth or zenith angle in which the beam leaves, rad; recorded: the angle that the scanner records, rad",
        "n: random error of the angle, rad",
        "sigma: the parameter `azimuth_sigma_rad` or `zenith_sigma_rad`",
        "N",
    ),
    "collimation": ("daz", "c: the parameter `angle_rad`", "z"),
    "horizontal_eccentricity": ("daz", "az", "a: the parameter `amplitude_rad`", "phase"),
    "tilt_drift": (
        "w: rotation vector with the components w_x, w_y and 0 along the scanner's axes, rad",
        "s: elapsed share of the scan's duration, from 0 to 1",
        "rate_x, rate_y: the parameters `rate_x_rad` and `rate_y_rad`",
        "u: unit vector of the true direction; w x u: vector product",
        "daz",
        "dz",
        "az",
        "z",
    ),
    "trunnion_tilt": ("daz", "t: the parameter `angle_rad`", "z"),
    "vertical_eccentricity": ("dz", "z", "a: the parameter `amplitude_rad`", "phase"),
    "vertical_index": ("dz", "offset: the parameter `offset_rad`"),
    "wobble": (
        "dz",
        "a: the parameter `amplitude_rad`",
        "line: number of the scan line, from 0 at the first",
        "n: the parameter `lines_per_cycle`",
        "phase",
    ),
    "beam_divergence": (
        "D: the parameter `divergence_rad`",
        "1/e^2: intensity of the beam at the angle D / 2 from its axis, relative to that on the axis; e is Euler's number",
        "c: speed of light, m/s",
        "tau: the parameter `pulse_width_s`",
        "R",
        "i",
    ),
    "range_cyclic": ("dR", "R", "A: the parameter `amplitude_m`", "period: the parameter `period_m`", "phase"),
    "range_incidence_bias": ("dR", "k: the parameter `coefficient_m`", "i"),
    "range_intensity_bias": ("dR", "k: the parameter `coefficient_m`", "I", "I_0: the parameter `reference_power`"),
    "range_noise": ("dR", "N", "sigma: the parameter `sigma_m`"),
    "range_noise_incidence": ("dR", "N", "sigma: the parameter `sigma_m`", "i"),
    "range_noise_intensity": ("dR", "N", "a: the parameter `a_m`", "I", "exponent: the parameter `exponent`"),
    "range_noise_proportional": ("dR", "N", "ppm: the parameter `ppm`, in parts per million", "R"),
    "range_offset": ("dR", "offset: the parameter `offset_m`"),
    "range_scale": ("dR", "scale: the parameter `scale_ppm`, in parts per million", "R"),
    "range_quantization": ("step: the parameter `step_m`",),
    "detection_limit": ("rho: albedo, the share of the light that the rock reflects", "i", "R"),
    "precipitation": (
        "beta: the parameter `rate_per_m`",
        "R",
        "r: range of the drop, m",
    ),
    "affinity_skew": ("b: affinity b1 and skew b2, px; without an index, the parameters `b1_px` and `b2_px`", "_real", "px"),
    "camera_kappa": ("rotation", "_real", "R_z(angle): rotation about the z axis; angle: the parameter `angle_rad`"),
    "camera_omega": ("rotation", "_real", "R_x(angle): rotation about the x axis; angle: the parameter `angle_rad`"),
    "camera_phi": ("rotation", "_real", "R_y(angle): rotation about the y axis; angle: the parameter `angle_rad`"),
    "camera_shift": (
        "X_real, X_nominal: place of the perspective centre, world frame, m",
        "_real",
        "x, y, z: the parameters `x_m`, `y_m` and `z_m`",
    ),
    "focal_length": ("f_real, f_nominal: principal distance, px", "_real", "delta: the parameter `delta_px`", "px"),
    "principal_point_x": ("cx_real, cx_nominal: principal point along x, px", "_real", "delta: the parameter `delta_px`", "px"),
    "principal_point_y": ("cy_real, cy_nominal: principal point along y, px", "_real", "delta: the parameter `delta_px`", "px"),
    "radial_distortion": (
        "k_real, k_nominal: coefficients k1 to k4 of the radial distortion",
        "_real",
        "k: the parameters `k1` to `k4`",
        "Z: depth along the axis of the rectified left camera, m; dZ: recorded minus true depth, m",
        "u, v: tangents of the angles from this axis along rows and columns",
        "b: base / Z, where base is the distance between the cameras, m",
    ),
    "tangential_distortion": (
        "p_real, p_nominal: coefficients p1 and p2 of the tangential distortion",
        "_real",
        "p: the parameters `p1` and `p2`",
    ),
    "row_jitter": (
        "dx: recorded minus ideal column of a pixel, px",
        "A: the parameter `amplitude_px`",
        "v: row of the pixel from the top of its image, px",
        "n: the parameter `rows_per_cycle`",
        "phase",
        "px",
    ),
    "fronto_parallel_bias": (
        "dd",
        "a: the parameter `slope_px`",
        "b: the parameter `row_px`",
        "L: the parameter `limit_px`",
        "d",
        "d_u: change of the disparity for each px along the row",
        "|grad d|: length of the gradient of the disparity along row and column",
        "px",
    ),
    "edge_fattening": ("d", "d'", "p, q: cells of the depth map", "r: the parameter `radius_px`", "px"),
    "smoothing": (
        "d",
        "d'",
        "G: Gaussian with the standard deviation sigma",
        "m: 1 where there is a match, else 0",
        "sigma_px",
        "s: slope of the disparity",
        "px",
    ),
    "regularization_noise": (
        "dd",
        "uv",
        "i, j: number of a node along the columns and along the rows of the image",
        "w_ij: weight of the node",
        "g_ij: random value at the node, px",
        "N",
        "sigma_px",
        "step: the parameter `step_px`",
        "px",
    ),
    "parallax_noise": ("dd", "N", "sigma_px", "px"),
    "texture_noise": (
        "sigma_d: standard deviation of the disparity, px",
        "k: the parameter `coefficient`",
        "sigma_I: noise of the image, grey values",
        "gx: horizontal gradient of the image in a cell of the depth map, grey values per px",
        "px",
    ),
    "pixel_locking": (
        "dd",
        "A: the parameter `amplitude_px`",
        "d: disparity that the matcher finds, px",
        "n: the parameter `period_px`",
        "phase",
        "px",
    ),
    "tile_shift": (
        "dd",
        "A: the parameter `amplitude_px`",
        "i, j: column and row of the tile",
        "uv",
        "n: the parameter `tile_px`",
        "px",
    ),
    "occlusion_fill": (
        "d'",
        "d_before, d_after: disparity of the cell before and after the strip, px",
        "reach: the parameter `reach_px`",
        "px",
    ),
    "heavy_tailed_noise": (
        "dd",
        "sigma_px",
        "a, b: smooth random fields with mean 0 and variance 1",
        "t: the parameter `tail`",
        "step: the parameter `step_px`",
        "px",
    ),
}
"""The symbols in the equation of each effect: words, or a short name of `_PARTS`."""


def symbols(effect: type[Effect]) -> str:
    """Return the list of the symbols in the equation of an effect, in Markdown."""
    meanings = [_PARTS.get(each, each) for each in _SYMBOLS[effect.tag()]]
    return "\n".join(["Symbols:", "", *(f"- {meaning}" for meaning in meanings)])


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
    "Bleyer et al. 2011": "Bleyer, Rhemann and Rother (2011), PatchMatch stereo: stereo matching with slanted support "
    "windows, British"
    " Machine Vision Conference",
    "Kanade & Okutomi 1994": "Kanade and Okutomi (1994), A stereo matching algorithm with an adaptive window: theory and"
    " experiment, IEEE Transactions on Pattern Analysis and Machine Intelligence 16(9)",
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

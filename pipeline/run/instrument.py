"""Describe what a run was observed with, as rows of its report: sensor, position, distance, noise, sampling of the wall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.report.page import with_minus_sign
from pipeline.run.site import SensorSite
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import DrawnParameter, OrientationNoise
from sensors.stereo.exchanged import StereoSensor, pair_of
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import REDUCTION

_ARCSEC = np.degrees(1.0) * 3600
"""Seconds of arc per radian."""
_ONE_SIGMA = "(1 \N{GREEK SMALL LETTER SIGMA})"


def instrument_figures(site: SensorSite) -> dict[str, str]:
    """Describe the sensor of a run for the table at the top of its report: type, noise, errors, position and distance.

    site: the wall and the sensor. Returns the value with its unit, by the name of the table's row.
    """
    own = _scanner_figures(site.sensor, site) if isinstance(site.sensor, LaserScanner) else _pair_figures(site.sensor, site)
    return {**own, **_places(site)}


def _scanner_figures(scanner: LaserScanner, site: SensorSite) -> dict[str, str]:
    """Describe a laser scanner."""
    config, noise = scanner.config, scanner.model.noise
    steps = config.azimuth_step_rad, config.zenith_step_rad
    on_the_wall = [step * _ranges(site.mesh.vertices, scanner.position)[1] * 1e3 for step in steps]
    growing = f" and {noise.range_ppm:g} ppm of it" if noise.range_ppm else ""
    faces = ", mean of two faces" if config.faces == 2 else ""
    return {
        "Sensor": f"terrestrial laser scanner, {config.name or 'of no preset'}; {config.pulse_rate_hz / 1e3:g} kHz{faces}",
        "Noise": f"range {noise.range_sigma_m * 1e3:.3g} mm{growing}, angles {noise.angle_sigma_rad * _ARCSEC:.3g}″ {_ONE_SIGMA}",
        "Effects": _effects(scanner.model.effects),
        "Angular step": " x ".join(f"{step * 1e3:.3g}" for step in steps)
        + " mrad, azimuth x zenith; "
        + " x ".join(f"{size:.3g}" for size in on_the_wall)
        + " mm at the median distance",
    }


def _pair_figures(sensor: StereoSensor, site: SensorSite) -> dict[str, str]:
    """Describe a stereo pair."""
    pair = pair_of(sensor)
    left, right, noise = pair.cameras.left, pair.cameras.right, pair.model.noise
    base = float(np.linalg.norm(right.position - left.position))
    pixel_mm = _ranges(site.mesh.vertices, site.frame.to_wall(left.position))[1] / left.f_px * 1e3
    smooth = f"{noise.regularization_sigma_px:g} px every {noise.regularization_step_px:g} px (regularization)"
    simulated = f"{noise.parallax_sigma_px:g} px (parallax) and {smooth}"
    matched = "the matcher's own: photographs are rendered and matched (sgbm)"
    for_whom = " for both cameras alike" if noise.orientation_drawn == "both_alike" else ""
    drawn = f"; orientation drawn in each epoch{for_whom}" if _is_drawn(noise.orientation) else ""
    return {
        "Sensor": f"stereo pair, {left.width} x {left.height} px, principal distance {left.f_px:,.0f} px, base {base:.2f} m",
        "Noise": f"{matched if isinstance(sensor, MatchedStereoPair) else simulated}{drawn} {_ONE_SIGMA}",
        "Effects": _effects(pair.model.effects),
        "Pixel on the wall": f"{pixel_mm:.3g} mm at the median distance; depth map {REDUCTION[pair.quality] * pixel_mm:.3g} mm",
    }


def _is_drawn(noise: OrientationNoise) -> bool:
    """Return whether any orientation parameter differs from its calibrated value."""
    return any(getattr(noise, name) != DrawnParameter() for name in type(noise).model_fields)


def _effects(effects: Sequence[Effect]) -> str:
    """List the effects by name, with the parameters that are not at their defaults."""
    return "; ".join(_with_parameters(effect) for effect in effects if not effect.is_null) or "none beyond the noise"


def _with_parameters(effect: Effect) -> str:
    """Describe one effect."""
    values = {name: getattr(effect, name) for name in type(effect).model_fields if name != "name"}
    own = {name: value for name, value in values.items() if value != type(effect).model_fields[name].default}
    told = ", ".join(f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in own.items())
    return f"{effect.name} ({told})" if told else effect.name


def _places(site: SensorSite) -> dict[str, str]:
    """Return the world coordinates of the sensor's viewpoints, and the distance of the wall from each."""
    return {
        row: value
        for name, eye in site.viewpoints.items()
        for row, value in (
            (
                f"Position ({name})",
                ", ".join(with_minus_sign(each, 2) for each in site.frame.to_world(eye)) + " m (x, y, z, world)",
            ),
            (f"Distance to the wall ({name})", _in_words(_ranges(site.mesh.vertices, eye))),
        )
    }


def _ranges(vertices: FloatArray, eye: FloatArray) -> tuple[float, float, float]:
    """Return smallest, median and largest distance, m, of vertices (n, 3) from a viewpoint (3,) in the same frame."""
    least, median, largest = np.quantile(np.linalg.norm(vertices - eye, axis=1), [0.0, 0.5, 1.0])
    return float(least), float(median), float(largest)


def _in_words(ranges: tuple[float, float, float]) -> str:
    """Describe distances in words."""
    least, median, largest = ranges
    return f"{median:.1f} m (median; {least:.1f} m to {largest:.1f} m)"

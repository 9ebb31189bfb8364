"""Predict the level of detection with a laser scanner's model, to compare it with the measured one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.monitoring.gridding import HeightRaster
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.significance import NORMAL_95
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

if TYPE_CHECKING:
    from sensors.models.sensor_model import TlsModel

DISAGREES = 1 / 3
"""Share by which the measured level may differ from the predicted one before it is worth a diagnosis."""


def scanner_model(options: MonitorOptions) -> TlsModel | None:
    """Return the laser scanner's noise model that the options name by a file or a preset; None if they name neither.

    Raises InputError if the file holds the model of a stereo pair.
    """
    if options.model is None and options.scanner is None:
        return None
    from pipeline.config.presets import read_preset  # with all effects, which take long to import
    from pipeline.formats.measurements.model_file import read_model
    from sensors.models.sensor_model import TlsModel

    if options.model is not None:
        model = read_model(options.model)
        if not isinstance(model, TlsModel):
            raise InputError(
                "the file is the model of a stereo pair, but `monitor` needs the model of a laser scanner",
                where=str(options.model),
                allowed="sensor: tls",
                remedy="give the model of a laser scanner, or leave --model out",
            )
        return model
    return None if options.scanner is None else read_preset(options.scanner).model()


def predicted_level(model: TlsModel, reference: HeightRaster, epoch: HeightRaster, station: FloatArray) -> float:
    """Predict the median level of detection at 95 %, m, from a scanner's white noise, to compare it with the measured one.

    Parameters
    ----------
    model : TlsModel
        The scanner's noise of range and angles.
    reference, epoch : HeightRaster
        The two epochs. The reference's heights give the ranges; the points in each pixel tell how much averaging reduces noise.
    station : (3,) array
        Position of the scanner, wall frame, m.
    """
    grid = reference.grid
    x = grid.x_min + (np.arange(grid.width) + 0.5) * grid.gsd - station[0]
    y = grid.y_max - (np.arange(grid.height) + 0.5) * grid.gsd - station[1]
    z = reference.height.astype(np.float64) - station[2]
    distance = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + z**2)
    cosine = np.abs(z) / distance
    along = np.hypot(model.noise.range_sigma_m, 1e-6 * model.noise.range_ppm * distance)
    across = model.noise.angle_sigma_rad * distance
    point = np.sqrt((along * cosine) ** 2 + across**2 * (1 - cosine**2))
    share = (reference.sigma / reference.scatter) ** 2 + (epoch.sigma / epoch.scatter) ** 2
    return float(NORMAL_95 * np.nanmedian(point * np.sqrt(share)))


def compared_in_words(measured_m: float, predicted_m: float, next_step: str) -> str:
    """State the measured and the predicted level of detection as text, and what to do if they differ by more than a third.

    measured_m, predicted_m: the two levels, m. next_step: sentence that says how to find the reason; empty if there is no way.
    """
    told = f"Level of detection: measured {1e3 * measured_m:.1f} mm, predicted by the model {1e3 * predicted_m:.1f} mm"
    if abs(measured_m / predicted_m - 1) <= DISAGREES:
        return f"{told}. They agree within a third."
    why = "They disagree by more than a third: relief between the points, or an effect that the model lacks."
    return f"{told}. {why} {next_step}".strip()

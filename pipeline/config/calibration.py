"""Define the settings of a calibration: stable areas, fitted parameters, amount of simulation."""

from __future__ import annotations

from pydantic import Field

from pipeline.change.areas import Area
from scene.common.config import Config


class CalibrationConfig(Config):
    """How `scarpsim calibrate` compares maps and searches for the noise parameters."""

    stable_areas: tuple[Area, ...] = Field(
        (), description="where nothing moved: boxes [x0, y0, x1, y1] or polygons [[x, y], ...], wall frame [m]; none: found"
    )
    fit: tuple[str, ...] = Field(
        (),
        description="what is fitted; none: parallax_sigma_px, regularization_sigma_px, regularization_step_px and orientation (a "
        "factor for the config's sigmas of the orientation) for stereo, range_sigma_m and angle_sigma_rad for tls; also "
        "range_ppm and single sigmas such as orientation.k1",
    )
    windows: int = Field(24, ge=6, le=400, description="square windows in which measured and simulated maps are compared")
    window_px: int = Field(64, ge=16, le=1024, description="side of a window, pixels of the difference map")
    simulations: int = Field(160, ge=60, le=100_000, description="simulated sets of epochs in the last round of the search")
    confidence: float = Field(0.95, gt=0.5, lt=1, description="confidence level of the intervals")

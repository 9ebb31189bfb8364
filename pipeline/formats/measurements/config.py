"""The keys of measurement.yaml and their allowed values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from pipeline.change.areas import Area
from pipeline.formats.measurements.checks import Sweep
from pipeline.formats.measurements.scanner_poses import ScannerPose, ScannerScan
from scene.common.config import Config

MOST_EPOCHS = 1000
"""Largest number of epochs."""


class ScanPattern(Config):
    """Nominal directions in which a laser scanner sends its pulses: start, stop and step of azimuth and zenith angle."""

    azimuth_rad: Sweep = Field(description="start, stop, step [rad]; or azimuth_deg")
    zenith_rad: Sweep = Field(description="start, stop, step [rad]; or zenith_deg")

    @model_validator(mode="before")
    @classmethod
    def _from_degrees(cls, values: Any) -> Any:
        """Convert angles in degrees."""
        if not isinstance(values, dict):
            return values
        found = dict(values)
        for name in ("azimuth", "zenith"):
            sweep = found.get(f"{name}_deg")
            if isinstance(sweep, list | tuple) and all(isinstance(each, int | float) for each in sweep):
                if f"{name}_rad" in found:
                    raise ValueError(f"'{name}_deg' and '{name}_rad' are both given; keep one")
                found[f"{name}_rad"] = [math.radians(each) for each in found.pop(f"{name}_deg")]
        return found

    @field_validator("azimuth_rad", "zenith_rad")
    @classmethod
    def _forward(cls, sweep: Sweep) -> Sweep:
        """Reverse the sweep of a scanner that turns the other way (step below 0): the directions are the same."""
        start, stop, step = sweep
        if step < 0 and stop < start:
            sweep = start + step * math.floor((stop - start) / step + 1e-6), start, -step
        if not (sweep[2] > 0 and sweep[1] > sweep[0]):
            raise ValueError("needs start < stop and a positive step, or start > stop and a negative step")
        if max(map(abs, sweep)) > 2 * math.pi:
            raise ValueError(
                f"is beyond a full turn; angles are in radians: {sweep[1]:g} degrees are {math.radians(sweep[1]):.4g}"
            )
        return sweep

    @field_validator("zenith_rad")
    @classmethod
    def _above_nadir(cls, sweep: Sweep) -> Sweep:
        """Check that zenith angles are between 0 and pi."""
        if sweep[0] < -sweep[2] or sweep[1] > math.pi + sweep[2]:
            raise ValueError("zenith angles run from 0, straight up, to pi, straight down")
        return sweep


class MeasurementConfig(Config):
    """Content of measurement.yaml, which describes measured points, reference surface and sensor model for `scarpsim gap`.

    A laser scan also needs the pose of the scanner: `scanner`, or `scanners` for several. `pattern` has the nominal directions of
    its pulses, if they are known.
    """

    sensor: Literal["tls", "stereo"]
    reference: Path = Field(description="reference surface, world frame, m")
    points: Path | Annotated[list[Path], Field(max_length=MOST_EPOCHS)] = Field(description="point cloud; several epochs: a list")
    frame: Literal["scanner", "world"] = Field("world", description="frame of the points")
    scanner: ScannerPose | None = None
    scanners: tuple[ScannerScan, ...] = Field(
        (), description="instead of `scanner`, if each file of `points` is a scan from its own position or in its own face"
    )
    pattern: ScanPattern | None = None
    cameras: Path | None = Field(
        None,
        description="cameras.yaml or a Metashape XML: the nominal calibration (stereo); none: the cameras are unknown",
    )
    stable_areas: tuple[Area, ...] = Field(
        (), description="where nothing moved: boxes [x0, y0, x1, y1] or polygons [[x, y], ...], wall frame [m]"
    )
    model: Path = Field(description="current sensor model")
    incidence: Literal["triangles", "planes"] | None = Field(
        None,
        description="what incidence angles refer to: the triangle hit, or a plane through 24 vertices around it (tls); none: "
        "planes if the vertices have noise, as points of a scan do",
    )
    reference_error_m: float | None = Field(
        None,
        ge=0,
        le=10,
        description="standard deviation of the reference's vertices along the rays, with independent errors [m] (tls); "
        "none: 0, or as estimated from the vertices if `incidence` is not given either",
    )
    reference_error_kind: Literal["noise", "scanner", "relief"] | None = Field(
        None,
        description="whether `reference_error_m` is noise of the vertices, which rays to the same triangles share; such noise "
        "of the scanner itself, larger where its model has more; or relief between the vertices (tls); none: as the scatter of "
        "the vertices about planes tells",
    )
    notes: tuple[str, ...] = Field(
        (), description="notes on the measurement for the report, such as what a reference cannot show"
    )

    @property
    def files(self) -> list[Path]:
        """The files of points, one or several."""
        return [self.points] if isinstance(self.points, Path) else self.points

    @field_validator("points")
    @classmethod
    def _some(cls, points: Path | list[Path]) -> Path | list[Path]:
        """Check that `points` names at least one file, and each file once."""
        if points == []:
            raise ValueError("names no file; give a path, or a list with one path for each epoch")
        if isinstance(points, list) and len(set(points)) < len(points):
            raise ValueError("names a file twice; give a different path for each epoch")
        return points

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Check that keys fit the sensor and each other."""
        if self.reference in self.files:
            raise ValueError("'reference' and 'points' name the same file, which cannot differ from itself; name another one")
        for name in ("incidence", "reference_error_m", "reference_error_kind"):
            if self.sensor == "stereo" and getattr(self, name) is not None:
                raise ValueError(f"'{name}' is for laser scans only; remove it")
        if self.scanners and len(self.scanners) != len(self.files):
            problem = f"'scanners' has {len(self.scanners)} poses for {len(self.files)} files of points; give one for each"
            raise ValueError(problem)
        if self.scanners and (self.scanner is not None or self.pattern is not None):
            raise ValueError("'scanners' replaces 'scanner' and excludes 'pattern'")
        return self

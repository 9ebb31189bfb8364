"""Define the sensor models: base noise and a list of effects.

They are the `sensor:` section of a config, and model.yaml of a measurement.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Side
from sensors.effects import StereoEffect, TlsEffect
from sensors.effects.affinity_skew import AffinitySkew
from sensors.effects.angle_noise import AngleNoise
from sensors.effects.base import Effect, Stage
from sensors.effects.camera_kappa import CameraKappa
from sensors.effects.camera_omega import CameraOmega
from sensors.effects.camera_phi import CameraPhi
from sensors.effects.camera_shift import CameraShift
from sensors.effects.focal_length import FocalLength
from sensors.effects.matching_noise import MatchingNoise
from sensors.effects.parallax_noise import ParallaxNoise
from sensors.effects.point_noise import PointNoise
from sensors.effects.principal_point_x import PrincipalPointX
from sensors.effects.principal_point_y import PrincipalPointY
from sensors.effects.radial_distortion import RadialDistortion
from sensors.effects.range_noise import RangeNoise
from sensors.effects.range_noise_proportional import RangeNoiseProportional
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.effects.tangential_distortion import TangentialDistortion
from sensors.signal_chain.pulses import PulseGeometry

MOST_EFFECTS = 100
"""Most effects in a model. Each adds to the kernel of an observation, which then has to be compiled."""


class TlsNoise(Config):
    """White noise of a laser scanner, as a data sheet states it.

    It is drawn anew for each pulse. The two parts of the range's noise add in quadrature.
    """

    range_sigma_m: float = Field(0.003, ge=0, le=10, description="standard deviation of the range [m]")
    range_ppm: float = Field(0.0, ge=0, le=1e5, description="further standard deviation of the range, in proportion to it [ppm]")
    angle_sigma_rad: float = Field(0.00005, ge=0, le=0.1, description="standard deviation of azimuth and of zenith [rad]")


class TlsModel(Config):
    """Sensor model of a laser scanner: base noise and effects.

    Effects are further errors, systematic or random, by their names in the catalogue.
    """

    sensor: Literal["tls"] = "tls"
    noise: TlsNoise = TlsNoise()
    effects: tuple[TlsEffect, ...] = Field(
        (), max_length=MOST_EFFECTS, description="effects of the catalogue beyond the base noise"
    )

    @model_validator(mode="after")
    def _one_beam(self) -> TlsModel:
        if sum(effect.stage == Stage.FOOTPRINT for effect in self.effects) > 1:
            raise ValueError("a scanner has one beam: name beam_divergence once")
        return self

    def without_noise(self) -> TlsModel:
        """Return the model with the same effects (further errors) but no base noise, to see what the effects do alone."""
        return self.model_copy(update={"noise": TlsNoise(range_sigma_m=0.0, angle_sigma_rad=0.0)})

    def variance(self, at: PulseGeometry) -> FloatArray:
        """Return the variance of recorded ranges that the model predicts, (n,), m2.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.asarray(sum((effect.variance(at) for effect in self.chain()), np.zeros(len(at))))

    def chain(self) -> tuple[Effect, ...]:
        """Return the base noise and the further errors as one list of effects, as the simulation applies them."""
        noise = self.noise
        return (
            AngleNoise(azimuth_sigma_rad=noise.angle_sigma_rad, zenith_sigma_rad=noise.angle_sigma_rad),
            RangeNoise(sigma_m=noise.range_sigma_m),
            RangeNoiseProportional(ppm=noise.range_ppm),
            *self.effects,
        )


class DrawnParameter(Config):
    """Normal distribution from which an error of a camera's orientation is drawn at each observation.

    The error is the real minus the calibrated value of one orientation parameter. A single number in a config is the standard
    deviation, with mean 0.
    """

    mean: float = Field(0.0, description="mean, in the parameter's unit")
    sigma: float = Field(0.0, ge=0, description="standard deviation, in the parameter's unit")

    @model_validator(mode="before")
    @classmethod
    def _number(cls, value: Any) -> Any:
        return {"sigma": value} if isinstance(value, int | float) else value


class OrientationNoise(Config):
    """Noise of the 6 exterior and 11 interior orientation parameters of each camera: real minus calibrated values.

    Each is drawn once for an observation. The exterior orientation is the pose of the camera; the interior orientation is its
    principal distance, principal point and distortion, in Metashape's model.
    """

    omega_rad: DrawnParameter = Field(DrawnParameter(), description="rotation about the camera's x axis [rad]")
    phi_rad: DrawnParameter = Field(DrawnParameter(), description="rotation about the camera's y axis [rad]")
    kappa_rad: DrawnParameter = Field(DrawnParameter(), description="rotation about the camera's z axis [rad]")
    x_m: DrawnParameter = Field(DrawnParameter(), description="perspective centre, world x [m]")
    y_m: DrawnParameter = Field(DrawnParameter(), description="perspective centre, world y [m]")
    z_m: DrawnParameter = Field(DrawnParameter(), description="perspective centre, world z [m]")
    f_px: DrawnParameter = Field(DrawnParameter(), description="principal distance [px]")
    cx_px: DrawnParameter = Field(DrawnParameter(), description="principal point x [px]")
    cy_px: DrawnParameter = Field(DrawnParameter(), description="principal point y [px]")
    b1: DrawnParameter = Field(DrawnParameter(), description="affinity [px]")
    b2: DrawnParameter = Field(DrawnParameter(), description="skew [px]")
    k1: DrawnParameter = Field(DrawnParameter(), description="radial distortion, r^2")
    k2: DrawnParameter = Field(DrawnParameter(), description="radial distortion, r^4")
    k3: DrawnParameter = Field(DrawnParameter(), description="radial distortion, r^6")
    k4: DrawnParameter = Field(DrawnParameter(), description="radial distortion, r^8")
    p1: DrawnParameter = Field(DrawnParameter(), description="tangential distortion, Metashape's order")
    p2: DrawnParameter = Field(DrawnParameter(), description="tangential distortion, Metashape's order")

    def draw(self, side: Side, random: KeyedRandom) -> tuple[Effect, ...]:
        """Draw the errors of all orientation parameters of a camera, as effects.

        side: the camera, "left", "right" or "both" (the same errors for both). random: source of random numbers; each parameter
        has its own. Raises InputError if a drawn value exceeds an effect's bounds.
        """
        value = {name: self._draw(name, random.child(name)) for name in type(self).model_fields}
        try:
            return self._effects(side, value)
        except ValidationError as error:
            problem = "; ".join(f"{item['loc'][-1]} {item['input']:.4g}: {item['msg'].lower()}" for item in error.errors())
            raise InputError(
                f"an orientation error, drawn at random, puts a camera parameter out of its bounds: {problem}",
                where="noise.orientation",
                remedy="lower the sigma of this parameter in noise.orientation; angles are in radians",
            ) from None

    def _effects(self, side: Side, value: dict[str, float]) -> tuple[Effect, ...]:
        """Convert drawn values to effects."""
        return (
            FocalLength(camera=side, delta_px=value["f_px"]),
            PrincipalPointX(camera=side, delta_px=value["cx_px"]),
            PrincipalPointY(camera=side, delta_px=value["cy_px"]),
            RadialDistortion(camera=side, **{key: value[key] for key in ("k1", "k2", "k3", "k4")}),
            TangentialDistortion(camera=side, p1=value["p1"], p2=value["p2"]),
            AffinitySkew(camera=side, b1_px=value["b1"], b2_px=value["b2"]),
            CameraOmega(camera=side, angle_rad=value["omega_rad"]),
            CameraPhi(camera=side, angle_rad=value["phi_rad"]),
            CameraKappa(camera=side, angle_rad=value["kappa_rad"]),
            CameraShift(camera=side, x_m=value["x_m"], y_m=value["y_m"], z_m=value["z_m"]),
        )

    def _draw(self, name: str, random: KeyedRandom) -> float:
        """Draw one parameter."""
        spread: DrawnParameter = getattr(self, name)
        return spread.mean + spread.sigma * float(random.generator().standard_normal())


class StereoNoise(Config):
    """Noise of a stereo pair: matching noise, and orientation noise drawn at each observation.

    Matching noise is that of disparities. Its white part is independent for each cell; its grid-correlated part is drawn at the
    nodes of a grid over the image and interpolated between them, so that neighbours share it. Orientation noise is that of the
    cameras' calibration and pose.
    """

    parallax_sigma_px: float = Field(
        0.3, ge=0, le=1000, description="white noise of the disparity [px of the full-resolution frame]"
    )
    regularization_sigma_px: float = Field(
        0.1, ge=0, le=1000, description="grid-correlated noise of the disparity: standard deviation at the nodes [px]"
    )
    regularization_step_px: float = Field(
        32.0, gt=0, le=100_000, description="distance between the grid's nodes [px of the full-resolution frame]"
    )
    point_sigma_m: float = Field(
        0.0, ge=0, le=10, description="white noise of the points along the surface's normal, for a cloud without cameras [m]"
    )
    point_shared_sigma_m: float = Field(
        0.0, ge=0, le=10, description="grid-correlated noise of the points, at the nodes of a grid over the wall's plane [m]"
    )
    point_shared_step_m: float = Field(0.1, gt=0, le=1000, description="distance between that grid's nodes [m]")
    orientation: OrientationNoise = OrientationNoise()
    orientation_drawn: Literal["each_camera", "both_alike"] = Field(
        "each_camera",
        description="whether each camera has its own orientation noise, or both share one draw, most of which cancels",
    )

    def draw(self, random: KeyedRandom) -> tuple[Effect, ...]:
        """Draw the cameras' errors of orientation (real minus calibrated) for one observation, as effects.

        random: source of random numbers of that observation.
        """
        sides: tuple[Side, ...] = ("both",) if self.orientation_drawn == "both_alike" else ("left", "right")
        return tuple(effect for side in sides for effect in self.orientation.draw(side, random.child(side)))

    @property
    def of_points(self) -> PointNoise:
        """Noise of recorded points along the surface's normal, as an effect with the values of the three keys `point_...`, m.

        It serves for a point cloud that comes without cameras, where noise of the disparity cannot be given.
        """
        sigma, shared, step = self.point_sigma_m, self.point_shared_sigma_m, self.point_shared_step_m
        return PointNoise(sigma_m=sigma, shared_sigma_m=shared, shared_step_m=step)


class StereoModel(Config):
    """Sensor model of a stereo pair: base noise and effects.

    Effects are further errors, systematic or random, by their names in the catalogue.
    """

    sensor: Literal["stereo"] = "stereo"
    noise: StereoNoise = StereoNoise()
    effects: tuple[StereoEffect, ...] = Field(
        (), max_length=MOST_EFFECTS, description="effects of the catalogue beyond the base noise"
    )

    def without_noise(self) -> StereoModel:
        """Return the model with the same effects (further errors) but no base noise, to see what the effects do alone."""
        return self.model_copy(update={"noise": StereoNoise(parallax_sigma_px=0.0, regularization_sigma_px=0.0)})

    @property
    def matching_noise(self) -> tuple[MatchingNoise, ...]:
        """Noise of the disparity whose semivariogram is known: from the base noise and from the further errors of the model."""
        noise = self.noise
        base = (
            ParallaxNoise(sigma_px=noise.parallax_sigma_px),
            RegularizationNoise(sigma_px=noise.regularization_sigma_px, step_px=noise.regularization_step_px),
        )
        return (*base, *(effect for effect in self.effects if isinstance(effect, MatchingNoise)))

    @property
    def variance(self) -> float:
        """Variance of a disparity that the model predicts, averaged over the image, px2."""
        return sum(effect.total_variance for effect in self.matching_noise)

    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """Return the semivariogram (k,), px2, that the model predicts: half the mean squared difference of disparity errors.

        lag: (k, 2) columns and rows from one pixel to the other, px.
        """
        return np.asarray(sum((effect.semivariogram(lag) for effect in self.matching_noise), np.zeros(len(lag))))

    def chain(self, random: KeyedRandom) -> tuple[Effect, ...]:
        """Return the base noise and the further errors as one list of effects, as the simulation applies them.

        random: source of the cameras' errors of orientation, which are drawn for each observation.
        """
        noise = self.noise
        return (
            *noise.draw(random.child("orientation")),
            ParallaxNoise(sigma_px=noise.parallax_sigma_px),
            RegularizationNoise(sigma_px=noise.regularization_sigma_px, step_px=noise.regularization_step_px),
            noise.of_points,
            *self.effects,
        )

    def of_points(self) -> tuple[Effect, ...]:
        """Return those of the model's errors that act on recorded points, in metres, instead of on disparities.

        They include the base noise of points and the effects of the same kind.
        """
        return (self.noise.of_points, *(effect for effect in self.effects if effect.stage == Stage.POINT))

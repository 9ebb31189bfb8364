"""The registry of effects: every class that a config may name, in the catalogue's order."""

from __future__ import annotations

from typing import Annotated, Any, Union

from pydantic import BeforeValidator, Discriminator

from scene.errors import nearest
from sensors.effects.affinity_skew import AffinitySkew
from sensors.effects.angle_noise import AngleNoise
from sensors.effects.base import Effect
from sensors.effects.camera_kappa import CameraKappa
from sensors.effects.camera_omega import CameraOmega
from sensors.effects.camera_phi import CameraPhi
from sensors.effects.camera_shift import CameraShift
from sensors.effects.focal_length import FocalLength
from sensors.effects.parallax_noise import ParallaxNoise
from sensors.effects.principal_point_x import PrincipalPointX
from sensors.effects.principal_point_y import PrincipalPointY
from sensors.effects.radial_distortion import RadialDistortion
from sensors.effects.range_noise import RangeNoise
from sensors.effects.range_noise_proportional import RangeNoiseProportional
from sensors.effects.range_offset import RangeOffset
from sensors.effects.range_scale import RangeScale
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.effects.tangential_distortion import TangentialDistortion

TLS_EFFECTS: tuple[type[Effect], ...] = (RangeOffset, RangeScale, RangeNoise, RangeNoiseProportional, AngleNoise)

STEREO_EFFECTS: tuple[type[Effect], ...] = (
    FocalLength,
    PrincipalPointX,
    PrincipalPointY,
    RadialDistortion,
    TangentialDistortion,
    AffinitySkew,
    CameraOmega,
    CameraPhi,
    CameraKappa,
    CameraShift,
    ParallaxNoise,
    RegularizationNoise,
)


def _named(effects: tuple[type[Effect], ...]) -> Any:
    """The type of one entry of an `effects:` list: a mapping whose `name` picks the class out of `effects`."""
    names = [effect.model_fields["name"].default for effect in effects]
    prefix = f"{effects[0].sensor}."

    def check(value: Any) -> Any:
        if isinstance(value, dict):
            name = str(value.get("name", "")).removeprefix(prefix)
            if name not in names:
                known = nearest(name, names) or f"allowed: {', '.join(names)}"
                raise ValueError(f"unknown {effects[0].sensor} effect '{name}'; {known}")
            return {**value, "name": name}
        return value

    return Annotated[Union[effects], Discriminator("name"), BeforeValidator(check)]  # noqa: UP007 (built at run time)


TlsEffect = _named(TLS_EFFECTS)
StereoEffect = _named(STEREO_EFFECTS)

__all__ = [
    "STEREO_EFFECTS",
    "TLS_EFFECTS",
    "AffinitySkew",
    "AngleNoise",
    "CameraKappa",
    "CameraOmega",
    "CameraPhi",
    "CameraShift",
    "Effect",
    "FocalLength",
    "ParallaxNoise",
    "PrincipalPointX",
    "PrincipalPointY",
    "RadialDistortion",
    "RangeNoise",
    "RangeNoiseProportional",
    "RangeOffset",
    "RangeScale",
    "RegularizationNoise",
    "StereoEffect",
    "TangentialDistortion",
    "TlsEffect",
]

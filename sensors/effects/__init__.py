"""The registry of effects: every class that a config may name, in the catalogue's order."""

from __future__ import annotations

from typing import Annotated, Any, Union

from pydantic import AfterValidator, BeforeValidator, Discriminator

from scene.errors import nearest
from sensors.effects.affinity_skew import AffinitySkew
from sensors.effects.angle_noise import AngleNoise
from sensors.effects.base import Effect
from sensors.effects.beam_divergence import BeamDivergence
from sensors.effects.camera_kappa import CameraKappa
from sensors.effects.camera_omega import CameraOmega
from sensors.effects.camera_phi import CameraPhi
from sensors.effects.camera_shift import CameraShift
from sensors.effects.collimation import Collimation
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.disparity_empirical import DisparityEmpirical
from sensors.effects.edge_fattening import EdgeFattening
from sensors.effects.focal_length import FocalLength
from sensors.effects.heavy_tailed_noise import HeavyTailedNoise
from sensors.effects.horizontal_eccentricity import HorizontalEccentricity
from sensors.effects.occlusion_fill import OcclusionFill
from sensors.effects.parallax_noise import ParallaxNoise
from sensors.effects.pixel_locking import PixelLocking
from sensors.effects.precipitation import Precipitation
from sensors.effects.principal_point_x import PrincipalPointX
from sensors.effects.principal_point_y import PrincipalPointY
from sensors.effects.radial_distortion import RadialDistortion
from sensors.effects.range_cyclic import RangeCyclic
from sensors.effects.range_empirical import RangeEmpirical
from sensors.effects.range_incidence_bias import RangeIncidenceBias
from sensors.effects.range_intensity_bias import RangeIntensityBias
from sensors.effects.range_noise import RangeNoise
from sensors.effects.range_noise_incidence import RangeNoiseIncidence
from sensors.effects.range_noise_intensity import RangeNoiseIntensity
from sensors.effects.range_noise_proportional import RangeNoiseProportional
from sensors.effects.range_offset import RangeOffset
from sensors.effects.range_quantization import RangeQuantization
from sensors.effects.range_scale import RangeScale
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.effects.row_jitter import RowJitter
from sensors.effects.smoothing import Smoothing
from sensors.effects.tangential_distortion import TangentialDistortion
from sensors.effects.texture_noise import TextureNoise
from sensors.effects.tilt_drift import TiltDrift
from sensors.effects.trunnion_tilt import TrunnionTilt
from sensors.effects.vertical_eccentricity import VerticalEccentricity
from sensors.effects.vertical_index import VerticalIndex
from sensors.effects.wobble import Wobble

TLS_EFFECTS: tuple[type[Effect], ...] = (
    RangeOffset,
    RangeScale,
    RangeCyclic,
    RangeIntensityBias,
    RangeIncidenceBias,
    RangeQuantization,
    RangeNoise,
    RangeNoiseProportional,
    RangeNoiseIncidence,
    RangeNoiseIntensity,
    AngleNoise,
    VerticalIndex,
    Collimation,
    TrunnionTilt,
    HorizontalEccentricity,
    VerticalEccentricity,
    Wobble,
    TiltDrift,
    BeamDivergence,
    DetectionLimit,
    Precipitation,
)

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
    PixelLocking,
    EdgeFattening,
    Smoothing,
    OcclusionFill,
    TextureNoise,
    RowJitter,
)

FURTHER_STEREO_EFFECTS: tuple[type[Effect], ...] = (HeavyTailedNoise,)
"""Beyond the shared catalogue: for simulation, no candidates of `scarpsim gap`."""


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

    checks = BeforeValidator(check), AfterValidator(_doing_something)
    return Annotated[Union[effects], Discriminator("name"), *checks]  # noqa: UP007 (built at run time)


def _doing_something(effect: Effect) -> Effect:
    """Refuse an effect that was named without the parameter that switches it on; one that is set to null by name stays."""
    switches = list(effect.nulls()) or ["values_m" if effect.sensor == "tls" else "values_px"]
    if effect.is_null and not effect.model_fields_set.intersection(switches):
        raise ValueError(f"{effect.name} does nothing without {' or '.join(switches)}; give a value")
    return effect


TlsEffect = _named((*TLS_EFFECTS, RangeEmpirical))
StereoEffect = _named((*STEREO_EFFECTS, *FURTHER_STEREO_EFFECTS, DisparityEmpirical))
"""What a config may name: the catalogue and, for what it does not explain, the empirical terms that `scarpsim gap` adds."""

__all__ = [
    "FURTHER_STEREO_EFFECTS",
    "STEREO_EFFECTS",
    "TLS_EFFECTS",
    "AffinitySkew",
    "AngleNoise",
    "BeamDivergence",
    "CameraKappa",
    "CameraOmega",
    "CameraPhi",
    "CameraShift",
    "Collimation",
    "DetectionLimit",
    "DisparityEmpirical",
    "EdgeFattening",
    "Effect",
    "FocalLength",
    "HeavyTailedNoise",
    "HorizontalEccentricity",
    "OcclusionFill",
    "ParallaxNoise",
    "PixelLocking",
    "Precipitation",
    "PrincipalPointX",
    "PrincipalPointY",
    "RadialDistortion",
    "RangeCyclic",
    "RangeEmpirical",
    "RangeIncidenceBias",
    "RangeIntensityBias",
    "RangeNoise",
    "RangeNoiseIncidence",
    "RangeNoiseIntensity",
    "RangeNoiseProportional",
    "RangeOffset",
    "RangeQuantization",
    "RangeScale",
    "RegularizationNoise",
    "RowJitter",
    "Smoothing",
    "StereoEffect",
    "TangentialDistortion",
    "TextureNoise",
    "TiltDrift",
    "TlsEffect",
    "TrunnionTilt",
    "VerticalEccentricity",
    "VerticalIndex",
    "Wobble",
]

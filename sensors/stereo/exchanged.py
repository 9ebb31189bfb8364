"""Make the right camera's depth map: the stereo sensor observes with both cameras upside down, which exchanges left and right.

The errors of the cameras and their exposures are the same as for the left depth map (the same `random` draws them). The errors
of the matching are drawn anew. Two depth maps of one real pair of photographs share much of their matching errors, so the mean
of both is more precise here than it would be in reality.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera
from sensors.effects.base import Effect, Stage
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.observation import Observation
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import REDUCTION, StereoPair

StereoSensor = StereoPair | MatchedStereoPair


def pair_of(sensor: StereoSensor) -> StereoPair:
    """Return the camera pair of a stereo sensor with its settings, for either kind of sensor.

    A `StereoPair`, which models the errors of matching, is returned itself; of a `MatchedStereoPair`, which matches rendered
    photographs, the pair that it contains is returned.
    """
    return sensor.pair if isinstance(sensor, MatchedStereoPair) else sensor


def observe_right(sensor: StereoSensor, scene: RayCaster, random: KeyedRandom) -> Observation:
    """Make the depth map of the right image, in addition to the one of the left image that `sensor.observe` makes.

    Call it with the same `scene` and `random`: both depth maps then belong to one observation. Rows and columns are those of
    the right image.
    """
    pair = pair_of(sensor)
    exchanged = replace(pair, cameras=pair.cameras.exchanged(), model=_ExchangedModel.of(pair))
    turned: StereoSensor = replace(sensor, pair=exchanged) if isinstance(sensor, MatchedStereoPair) else exchanged
    seen = turned.observe(scene, random)
    return replace(
        seen,
        points=_upside_down(seen.points),
        depth=_upside_down(seen.depth),
        block=_upside_down(seen.block),
        truth={name: _upside_down(channel) for name, channel in seen.truth.items()},
        offset=None if seen.offset is None else _upside_down(seen.offset),
    )


def depth_cameras(pair: StereoPair) -> tuple[Camera, Camera]:
    """Return the nominal (calibrated) cameras, wall frame, whose pixels are the cells of the left and right depth maps.

    pair: the stereo pair that makes the depth maps.
    """
    cameras, step = pair.cameras.in_wall_frame(pair.frame), REDUCTION[pair.quality]
    rows, columns = pair.shape
    rest = float(cameras.right.width - columns * step), float(cameras.right.height - rows * step)
    return cameras.left.reduced(step, columns, rows), cameras.right.reduced(step, columns, rows, rest)


class _ExchangedModel(StereoModel):
    """A stereo model for the exchanged pair, in which every effect acts on the cameras in their original position."""

    frame_height_px: int

    @classmethod
    def of(cls, pair: StereoPair) -> _ExchangedModel:
        """Make the model for the exchanged version of a pair."""
        return cls(noise=pair.model.noise, effects=pair.model.effects, frame_height_px=pair.cameras.left.height)

    def chain(self, random: KeyedRandom) -> tuple[Effect, ...]:
        """Return the effects, wrapped for the exchanged pair."""
        effects = super().chain(random)
        return cast(tuple[Effect, ...], tuple(_ExchangedEffect(effect, self.frame_height_px) for effect in effects))


@dataclass(frozen=True)
class _ExchangedEffect:
    """Wraps an effect so that `apply_stage` can apply it in an exchanged pair."""

    effect: Effect
    height: int

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def stage(self) -> Stage:
        return self.effect.stage

    @property
    def order(self) -> int:
        return self.effect.order

    @property
    def is_null(self) -> bool:
        return self.effect.is_null

    def apply(self, state: Any, random: KeyedRandom) -> Any:
        """Apply the effect to the original pair or exposure, and exchange the result."""
        if self.stage == Stage.CAMERA:
            return self.effect.apply(state.exchanged(), random).exchanged()
        if self.stage == Stage.EXPOSE:
            side = "left" if state.camera == "right" else "right"
            upright = self.effect.apply(replace(state, camera=side, v=self.height - state.v, du=-state.du), random)
            return replace(state, du=-upright.du)
        return self.effect.apply(state, random.child("exchanged"))


def _upside_down(image: Any) -> Any:
    """Turn an image (h, w, ...) upside down, rows and columns."""
    turned: FloatArray = np.ascontiguousarray(image[::-1, ::-1])
    return turned

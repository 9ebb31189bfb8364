"""Pixel locking: sub-pixel disparities are biased towards whole pixels."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.numerics.device import opaque
from sensors.numerics.functions import DEVICE, HOST, Functions
from sensors.signal_chain.matches import Matches


class PixelLocking(Effect):
    """The matcher's sub-pixel disparities are biased towards whole pixels.

    dd = A sin(2 pi d / n + phase), with the amplitude A and the disparity d. The period n is by default the reduction of the
    matched image (2, 4, 8 for high, medium, low quality), so that d / n counts its pixels. Semi-global matching has A of about
    0.2 to 0.25 px of the matched image, that is n times as much here (Shimizu & Okutomi 2005). The effect acts last, after all
    noise.
    """

    name: Literal["pixel_locking"] = "pixel_locking"
    means = "Sub-pixel disparities are drawn to whole pixels: terraces on the wall, at the depths of whole disparities."
    act = "Let the matcher refine below the pixel (a larger window, or a refinement after it), or give it larger pictures."
    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.VALUES
    order = 60
    amplitude_px: float = parameter(
        "largest change of the disparity", unit="px", source="Shimizu & Okutomi 2005", typical=0.8, ge=-100, le=100
    )

    period_px: float | None = Field(
        None, gt=0, description="n, if the matcher rectified to pixels of another size than here [px]; null: the reduction"
    )
    phase_rad: float = Field(0.0, description="phase, if the matcher's rectified columns start elsewhere than here [rad]")
    tilt_rad: float = Field(
        0.0, gt=-1, lt=1, description="rotation about the base of the matcher's rectification against the one here [rad]"
    )

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with the bias A sin(2 pi d / n + phase), px, added to each disparity d, which contains all noise.

        state: the matched cells of the depth map before this effect. `random` is not used.
        """
        amplitude, period, phase = opaque(self.amplitude_px, self.period_px or state.reduction, self.phase_rad)
        matched = state.disparity
        if self.tilt_rad:
            matched = _turned(matched, state.tangent, *opaque(state.infinity, math.tan(self.tilt_rad)))
        return replace(state, disparity=state.disparity + amplitude * _wave(matched / period, phase, DEVICE))

    def mean(self, at: Any) -> FloatArray:
        """Return the bias (n,) of the disparity towards whole pixels, px, at the disparities that the matcher found.

        at: geometry of n matched pixels of the stereo pair, as NumPy arrays.
        """
        matched = at.found
        if self.tilt_rad:
            matched = _turned(matched, at.tangent, at.infinity, math.tan(self.tilt_rad))
        return np.asarray(self.amplitude_px * _wave(matched / (self.period_px or 1.0), self.phase_rad, HOST))


def _turned(disparity: Any, tangent: Any, infinity: Any, turn: Any) -> Any:
    """Convert disparities (n,), px, to a rectification that is rotated about the base.

    The rotated rectification has f B / Z' with Z' = Z (1 + y tan w). Its change of scale is part of n.

    Parameters
    ----------
    disparity : (n,) array
        Disparities, px.
    tangent : (n,) array
        y, the tangent of the angle between the match's row and the rectified axis.
    infinity : float
        Disparity of a point at infinity, px.
    turn : float
        tan w, with w the rotation about the base.
    """
    return infinity + (disparity - infinity) / (1 + turn * tangent)


def _wave(pixels: Any, phase: Any, m: Functions) -> Any:
    """Return sin(2 pi d / n + phase), (n,), of disparities in pixels, d / n. Whole pixels are subtracted first, for precision."""
    return m.sin(2 * math.pi * (pixels - m.floor(pixels)) + phase)

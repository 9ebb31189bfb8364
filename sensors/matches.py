"""The stereo pair's matched pixels on their way through the chain."""

from __future__ import annotations

from dataclasses import dataclass

from scene.backend import mi


@dataclass(frozen=True)
class Matches:
    """n cells of the left depth map as lazy device arrays, all (n,); image quantities in px of the full-resolution frame.

    index: the cell's number, row by row (keys its random numbers); u, v: the cell's centre in the left image; disparity: of the
    rectified pair; matched: whether the cell has a match; width, height: of the frame.
    """

    index: mi.UInt32
    u: mi.Float64
    v: mi.Float64
    disparity: mi.Float64
    matched: mi.Bool
    width: int
    height: int

"""The errors of semi-global matching against those of the simulated matching noise: one table (docs/matching.md explains it).

On the Middlebury motorcycle (measured ground truth) and on rendered pairs of Glendale and Bulga (ray-traced truth). Pixels are
those of the matched pictures, so the simulated noise, given in px of the full frame, counts by the reduction.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scene.frame import WallFrame
from scene.illumination import IlluminationConfig
from scene.keyed_random import KeyedRandom
from scene.procedural import ProceduralWall
from scene.raycast import RayCaster
from scene.texture import TextureConfig
from sensors.exposure import ExposureConfig
from sensors.matching import MatchingConfig, SearchRange, match, without_speckles
from sensors.model import StereoModel
from sensors.observation import Observation
from sensors.placement import RigConfig, Target
from sensors.rectify import rectify
from sensors.refinement import refine
from sensors.stereo import REDUCTION, StereoPair
from sensors.stereo_matched import MatchedStereoPair

Raster = NDArray[np.float64]
FITTED = StereoModel(
    noise={"parallax_sigma_px": 0.35, "regularization_sigma_px": 1.2, "regularization_step_px": 16.0},
    effects=[{"name": "edge_fattening", "radius_px": 10.0}],
)
"""Simulated noise like the refined matcher's on rendered rock, px of the full frame at medium quality."""
QUIET = {"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motorcycle", type=Path, default=Path("/work/shared/data/stereo_motorcycle"))
    folder = parser.parse_args().motorcycle
    print("| pair | matcher | matched % | bias px | MAD-sigma px | > 1 px % | excess kurtosis | r(1) | r(8) | locking px |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    if folder.exists():
        report("motorcycle", motorcycle(folder))
    for style in ("glendale", "bulga"):
        report(style, rendered(style))


def report(pair: str, cases: Iterator[tuple[str, Raster, Raster]]) -> None:
    for matcher, found, true in cases:
        print(f"| {pair} | {matcher} | " + " | ".join(statistics(found, true)) + " |", flush=True)


def motorcycle(folder: Path) -> Iterator[tuple[str, Raster, Raster]]:
    """Found and true disparities of SGBM and of its refinement, px."""
    left, right = (cv2.imread(str(folder / f"motorcycle_{side}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right"))
    true = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(float)
    true[~np.isfinite(true)] = np.nan
    config = MatchingConfig()
    pictures = left.astype(np.float32), right.astype(np.float32)
    coarse = match(*pictures, SearchRange.between(float(np.nanmin(true)), float(np.nanmax(true))), config)
    yield "sgbm", without_speckles(coarse, config.speckle_px), true
    assert config.refinement
    yield "sgbm, refined", without_speckles(refine(*pictures, coarse, config.refinement), config.speckle_px), true


def rendered(style: str) -> Iterator[tuple[str, Raster, Raster]]:
    """Found and true disparities on a rendered wall 24 x 15 m seen from 50 m at medium quality, px of the depth map."""
    random = KeyedRandom(1)
    world = ProceduralWall(style=style, width_m=24.0, height_m=15.0, resolution_m=0.03, seed=7).mesh(random)
    cameras = RigConfig(distance_m=50.0, base_m=13.0).place(Target(world))
    frame = WallFrame.fit(world.vertices, cameras.left.position)
    caster = RayCaster(world.with_vertices(frame.to_wall(world.vertices)))
    quiet, texture = StereoPair(cameras, frame, StereoModel(noise=QUIET)), TextureConfig().texture(random)
    true = disparity(quiet.observe(caster, random), quiet)
    for name, config in (("sgbm", MatchingConfig(refinement=None)), ("sgbm, refined", MatchingConfig())):
        pair = MatchedStereoPair(quiet, texture, IlluminationConfig(), ExposureConfig(), config)
        yield name, disparity(pair.observe(caster, random), quiet), true
    for name, model in (("simulated, defaults", StereoModel()), ("simulated, fitted", FITTED)):
        yield name, disparity(StereoPair(cameras, frame, model).observe(caster, random), quiet), true


def disparity(seen: Observation, pair: StereoPair) -> Raster:
    """(rows, columns) disparity of the recorded points in the rectified nominal pair, px of the depth map."""
    nominal = pair.cameras.in_wall_frame(pair.frame)
    geometry = rectify(nominal)
    depth = (seen.points - nominal.left.position) @ nominal.left.rotation @ geometry.left.T[:, 2]
    return (geometry.f * geometry.base_m / depth + geometry.offset) / REDUCTION[pair.quality]


def statistics(found: Raster, true: Raster) -> list[str]:
    """The row of the table; kurtosis, correlation along the row and locking are those of errors below 1 px."""
    error = np.asarray(found, dtype=float) - true
    known = error[~np.isnan(error)]
    inner = np.where(np.abs(error) < 1, error, np.nan)
    values = inner[~np.isnan(inner)]
    centred = values - values.mean()
    kurtosis = np.mean(centred**4) / np.mean(centred**2) ** 2 - 3
    figures = [
        100 * known.size / np.count_nonzero(~np.isnan(true)),
        np.median(known),
        1.4826 * np.median(np.abs(known - np.median(known))),
        100 * np.mean(np.abs(known) > 1),
        kurtosis,
        correlation(inner, 1),
        correlation(inner, 8),
        locking(inner, true),
    ]
    return [f"{value:.{digits}f}" for value, digits in zip(figures, (1, 3, 3, 2, 1, 2, 2, 3), strict=True)]


def correlation(error: Raster, lag: int) -> float:
    """Autocorrelation of the errors along the row."""
    first, second = error[:, :-lag].ravel(), error[:, lag:].ravel()
    both = ~np.isnan(first) & ~np.isnan(second)
    return float(np.corrcoef(first[both], second[both])[0, 1])


def locking(error: Raster, true: Raster) -> float:
    """Amplitude of the sine of the true disparity's fraction in the errors, by least squares, px."""
    known = ~np.isnan(error)
    phase = 2 * np.pi * true[known]
    design = np.stack([np.ones_like(phase), np.sin(phase), np.cos(phase)], axis=1)
    _, sine, cosine = np.linalg.lstsq(design, error[known])[0]
    return float(np.hypot(sine, cosine))


if __name__ == "__main__":
    main()

"""Worked examples of `scarpsim gap` on data that no closed form made, each a measurement folder, a diagnosis and a page.

    python docs/make_gap_examples.py motorcycle|sgbm [--out runs/gap_examples] [--data ../shared/data]

motorcycle: real photographs, Middlebury 2014's motorcycle at 741 x 500 with its measured disparities as the reference, matched by
OpenCV's semi-global matching. sgbm: rendered photographs of a wall in Glendale's style, matched by the
same, against the simulated matcher.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from make_gap_pages import small_png

from pipeline.formats.cameras.cameras import write_cameras_yaml
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.meshes.ply import write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.gap.naming.named_effects import NamedEffect
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.report.report import summarise, write_report
from pipeline.gap.report.wording import format_parameters
from scene.appearance.illumination import IlluminationConfig
from scene.appearance.texture import TextureConfig
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.cameras.camera import Camera, CameraPair
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.stereo.exposure import ExposureConfig
from sensors.stereo.matching import MatchingConfig, SearchRange, match, without_speckles
from sensors.stereo.refinement import refine
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import REDUCTION, StereoPair

FOLDER = Path(__file__).parent / "validation"
F_PX, BASE_M, CX, CY, OFFSET_PX = 994.978, 0.193001, 311.193, 254.877, 31.086
"""Middlebury's calibration of the motorcycle at this size, principal point from the centre of the top-left pixel."""
_JUMP_PX = 1.0
"""Neighbouring disparities that differ by more belong to two surfaces."""
_MOST_POINTS = 60_000
_BELIEVED = {"parallax_sigma_px": 0.05, "regularization_sigma_px": 0.0, "regularization_step_px": 32}
"""A matcher that hardly errs: what it does beyond that is to be found."""


@dataclass(frozen=True)
class Pair:
    """A measurement to be written. points: (n, 3) world, m; pixels: (n, 2) of the left camera."""

    name: str
    reference: TriangleMesh
    points: FloatArray
    pixels: FloatArray
    cameras: CameraPair


def write_measurement(folder: Path, pair: Pair) -> None:
    """Make the folder that `scarpsim gap` takes, with a nearly perfect matcher as the model."""
    folder.mkdir(parents=True, exist_ok=True)
    some = slice(None, None, max(len(pair.points) // _MOST_POINTS, 1))
    write_ply(folder / "reference.ply", pair.reference)
    pixels = {"pixel_x": pair.pixels[some, 0], "pixel_y": pair.pixels[some, 1]}
    write_ply_points(folder / "surface.ply", PointCloud(pair.points[some], extra=pixels))
    write_cameras_yaml(folder / "cameras.yaml", pair.cameras)
    files = {"reference": "reference.ply", "points": "surface.ply", "cameras": "cameras.yaml", "model": "model.yaml"}
    (folder / "measurement.yaml").write_text(yaml.safe_dump({"sensor": "stereo", "frame": "world", **files}))
    (folder / "model.yaml").write_text(yaml.safe_dump({"sensor": "stereo", "noise": _BELIEVED, "effects": []}))


def motorcycle(data: Path) -> Iterator[Pair]:
    """SGBM on the photographs, and its refinement, against the measured disparities."""
    left, right = (cv2.imread(str(data / f"motorcycle_{side}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right"))
    assert left is not None
    assert right is not None
    true = np.load(data / "motorcycle_disp.npz")["arr_0"].astype(float)
    true[~np.isfinite(true)] = np.nan
    config = MatchingConfig()
    pictures = left.astype(np.float32), right.astype(np.float32)
    coarse = match(*pictures, SearchRange.between(float(np.nanmin(true)), float(np.nanmax(true))), config)
    assert config.refinement
    cameras, reference = _middlebury(left.shape), _surface(true)
    for name, disparity in (("sgbm", coarse), ("sgbm, refined", refine(*pictures, coarse, config.refinement))):
        found = np.asarray(without_speckles(disparity, config.speckle_px), dtype=float)
        rows, columns = np.nonzero(np.isfinite(found))
        points = _point(columns, rows, found[rows, columns])
        yield Pair(name, reference, points, np.stack([columns + 0.5, rows + 0.5], axis=1), cameras)


def _point(column: Any, row: Any, disparity: FloatArray) -> FloatArray:
    """(n, 3) world points (x right, y forward, z up) of left pixels and their disparities."""
    depth = F_PX * BASE_M / (disparity + OFFSET_PX)
    return np.stack([(column - CX) / F_PX * depth, depth, -(row - CY) / F_PX * depth], axis=1)


def _middlebury(shape: tuple[int, ...]) -> CameraPair:
    height, width = shape[:2]
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # columns: camera x, y, z in the world

    def camera(offset_px: float, x_m: float) -> Camera:
        cx, cy = CX + offset_px + 0.5 - width / 2, CY + 0.5 - height / 2
        lens = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
        return Camera(width, height, F_PX, cx, cy, 0.0, 0.0, **lens, position=np.array([x_m, 0.0, 0.0]), rotation=rotation)

    return CameraPair(camera(0.0, 0.0), camera(OFFSET_PX, BASE_M))


def _surface(true: FloatArray) -> TriangleMesh:
    """Measured disparities as a mesh, cut where they jump."""
    rows, columns = np.indices(true.shape)
    vertices = _point(columns.ravel(), rows.ravel(), true.ravel())
    number = np.arange(true.size).reshape(true.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, d, b], axis=1), np.stack([b, d, c], axis=1)])
    corners = true.ravel()[faces]
    faces = faces[np.isfinite(corners).all(axis=1) & (np.ptp(corners, axis=1) < _JUMP_PX)]
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(vertices[used], index.reshape(-1, 3).astype(np.int32))


def rendered() -> Iterator[Pair]:
    """SGBM on rendered photographs of a wall 24 x 15 m from 50 m at medium quality, and its refinement."""
    random = KeyedRandom(1)
    world = ProceduralWall(style="glendale", width_m=24.0, height_m=15.0, resolution_m=0.03, seed=7).mesh(random)
    cameras = RigConfig(distance_m=50.0, base_m=13.0).place(Target(world))
    frame = WallFrame.fit(world.vertices, cameras.left.position)
    caster = RayCaster(world.with_vertices(frame.to_wall(world.vertices)))
    quiet = StereoPair(cameras, frame, StereoModel(noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}))
    texture, step = TextureConfig().texture(random), REDUCTION["medium"]
    for name, config in (("sgbm", MatchingConfig(refinement=None)), ("sgbm, refined", MatchingConfig())):
        seen = MatchedStereoPair(quiet, texture, IlluminationConfig(), ExposureConfig(), config).observe(caster, random)
        rows, columns = np.nonzero(seen.valid)
        pixels = np.stack([(columns + 0.5) * step, (rows + 0.5) * step], axis=1)
        yield Pair(name, world, frame.to_world(seen.points[rows, columns]), pixels, cameras)


def run(pairs: Iterator[Pair], out: Path) -> list[tuple[str, GapDiagnosis]]:
    """Write and diagnose each measurement; folders under `out` hold the measurement and gap/ with the results."""
    found = []
    for pair in pairs:
        folder = out / pair.name.replace(", ", "_")
        write_measurement(folder, pair)
        measurement = read_measurement(folder)
        diagnosis = diagnose(measurement)
        write_report(folder / "gap", diagnosis, measurement)
        sys.stdout.write(f"{pair.name}: {summarise(diagnosis)}\n")
        found.append((pair.name, diagnosis))
    return found


def table(found: list[tuple[str, GapDiagnosis]]) -> str:
    """Verdict, effects with their standard deviations, and the gap of each."""
    rows = [
        "| matcher | points | verdict | what was named | before | after | floor | closed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, each in found:
        named = (
            "; ".join(f"`{effect.effect.tag()}` ({format_parameters(effect)}){_class(effect)}" for effect in each.effects)
            or "nothing"
        )
        gap = each.gap
        figures = ["", "", "", ""]
        if gap is not None:
            figures = [f"{1e3 * value:.2f} mm" for value in (gap.before, gap.after, gap.floor)]
            figures.append("within its uncertainty" if gap.closed is None else f"{100 * gap.closed:.0f} %")
        cells = (name, f"{len(each.residuals):,}", each.verdict, named, *figures)
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _class(effect: NamedEffect) -> str:
    """Words for what an effect cannot be told from, or for one that describes and does not explain."""
    if effect.kind == "empirical":
        return ", as a description"
    names = ", ".join(f"`{name.partition('.')[2]}`" for name in effect.indistinguishable)
    return f", cannot be told from {names}" if names else ""


def page(name: str, title: str, before: str, found: list[tuple[str, GapDiagnosis]]) -> None:
    """docs/validation/gap_<...>.md up to the line that marks hand-written text, which is kept."""
    path = FOLDER / f"{_FILES[name]}.md"
    kept = path.read_text().partition(_MARK)[2] if path.exists() else "\n"
    parts = [f"# {title}", before, table(found)]
    for matcher, _ in found:
        picture = slug_picture(f"{name}_{matcher.replace(', ', '_')}")
        parts.append(f"![Maps of the residuals before and after, {matcher}]({picture})")
    path.write_text("\n\n".join(parts) + f"\n\n{_MARK}{kept}")


def slug_picture(slug: str) -> str:
    """Place of a picture, as a page names it."""
    return f"images/{slug}.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("example", choices=("motorcycle", "sgbm"))
    parser.add_argument("--out", type=Path, default=Path("runs/gap_examples"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    arguments = parser.parse_args()
    if arguments.example == "motorcycle":
        name, title = "real_pair", "A pair of real photographs"
        pairs = motorcycle(arguments.data / "stereo_motorcycle")
    else:
        name, title, pairs = "sgbm", "A pair of rendered photographs", rendered()
    out = arguments.out / arguments.example
    found = run(pairs, out)
    for matcher, _ in found:
        folder = out / matcher.replace(", ", "_")
        picture = small_png((folder / "gap" / "maps.png").read_bytes())
        (FOLDER / slug_picture(f"{name}_{matcher.replace(', ', '_')}")).write_bytes(picture)
    page(name, title, _INTRODUCTIONS[name], found)


_FILES = {"real_pair": "gap_real_photographs", "sgbm": "gap_rendered_photographs"}
_MARK = "## What can be concluded"
_INTRODUCTIONS = {
    "real_pair": """\
This page shows what `scarpsim gap` says of a real matcher on real photographs, where the surface is known and the errors are not.
It is for users of photogrammetric surfaces who want to see how far an answer goes on data that no simulation made.

The scene is Middlebury 2014's motorcycle (741 x 500 px). OpenCV's semi-global matching gives the disparities, with and without
least-squares refinement. The reference is the surface of the disparities that the data set measured with structured light, cut
where they jump by more than 1 px. The model states a nearly perfect matcher: 0.05 px of white noise and no effects.

The answers find the pixel locking of the plain matcher, which the refinement removes, and the fattened edges and the smoothing of
both. This command makes the page's results:

    python docs/make_gap_examples.py motorcycle

It leaves the measurement folders and the reports in runs/gap_examples/motorcycle.

## Results

A residual is a measured minus a predicted disparity. `before` and `after` say how far the measured residuals are from those that
the model predicts, without and with the named effects, as a distance along the line of sight
([how](../explanation/gap_verdict.md#the-gap)). `floor` is what the noise alone would leave, and `closed` the share of the way
from `before` to `floor`. The [catalogue](../reference/effects/README.md) explains the effects and their parameters; values are
printed in a handy unit, such as mrad, whatever unit a parameter's name has.

The verdict does not follow from `closed` alone. In the first row it is `unknown`, because the model with the named effects is
still rejected, and validation blocks do not show that the gap is smaller. In the second row it is `several`, because all terms
are effects with a known cause and they close more than half of the gap, the least share that `gap` asks for.""",
    "sgbm": """\
This page shows what `scarpsim gap` says of a real matcher on rendered photographs, where the truth is known: the cameras are
perfect and the surface is exact, so whatever is found is due to the matcher. It is for users of photogrammetric surfaces.

A wall of 24 m x 15 m in the style of Glendale is rendered from 50 m (base 13 m, medium quality) and matched by OpenCV's
semi-global matching (`sgbm`), with and without least-squares refinement. The model states a nearly perfect matcher: 0.05 px
of white noise and no effects. Values are in pixels of the full image; a pixel of the matched pictures is 4 px of it.
[Matching](../explanation/matching.md) has the errors of the matchers.

The answers find the pixel locking of the plain matcher, the smoothing (a low-pass filter) of the refined one and the bias by
slope of both, and blame no camera. This command makes the page's results:

    python docs/make_gap_examples.py sgbm

It leaves the measurement folders and the reports in runs/gap_examples/sgbm.

## Results

A residual is a measured minus a predicted disparity. `before` and `after` say how far the measured residuals are from those that
the model predicts, without and with the named effects, as a distance along the line of sight
([how](../explanation/gap_verdict.md#the-gap)). `floor` is what noise alone would leave, and `closed` is the share of the way from
`before` to `floor`. The [catalogue](../reference/effects/README.md) explains the effects and their parameters; values are printed
in a handy unit, such as µrad, whatever unit a parameter's name has.

The verdict does not follow from `closed` alone. It is `several`, because all terms are effects with a known cause and they close
more than half of the gap, the least share that `gap` asks for.""",
}
"""What each page has before its table: what was evaluated, what it means, and how the table is read."""


if __name__ == "__main__":
    main()

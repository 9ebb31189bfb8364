"""Make good inputs of all commands, once; each bad input is a copy of them with something damaged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.gap_closed_form.cases import Case, make
from pipeline.change.annotate import run_length_encoding
from pipeline.cli.main import main
from pipeline.config.bundled import configs_folder
from pipeline.detection.products.events import Event, write_events
from pipeline.formats.files.atomic import write_json
from pipeline.formats.meshes.ply import read_ply, write_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.points.points import read_points
from scene.geometry.mesh import FloatArray, TriangleMesh

SITE: dict[str, Any] = {
    "seed": 3,
    "epochs": 2,
    "wall": {"style": "glendale", "width_m": 8.0, "height_m": 5.0, "resolution_m": 0.1, "seed": 1},
    "rockfall": {"count": 4, "size_m": 0.5},
    "cameras": {"distance_m": 20.0, "base_m": 5.0},
    "depth_map": "low",
    "station": {"distance_m": 20.0},
    "scanner": {"azimuth_step_rad": 0.008, "zenith_step_rad": 0.008},
    "difference": {"gsd_m": 0.05},
    "icp": {"max_iteration": 2},
    "calibration": {"windows": 6, "window_px": 16, "simulations": 60},
}
"""A site so small that a calibration of its run, with some 450 simulated epochs, takes 15 s of processor time."""
SET: dict[str, Any] = {
    "name": "tiny",
    "seed": 3,
    "sensors": ["tls"],
    "walls": {
        "ledge": {
            **{key: value for key, value in SITE.items() if key not in ("seed", "epochs", "calibration")},
            "scanner": {"azimuth_step_rad": 0.003, "zenith_step_rad": 0.003},
            "icp": {"max_iteration": 5},
        }
    },
    "noise": {
        "low": {
            "stereo": {"model": {"sensor": "stereo", "noise": {"parallax_sigma_px": 0.2}}},
            "tls": {"model": {"sensor": "tls"}, "scale": {"ledge": 2.0}},
        }
    },
    "sizes": {"large": {"blocks_per_m2": 0.35, "rockfall": {"size_m": {"kind": "uniform", "low": 0.4, "high": 0.6}}}},
    "tiles": {"size_px": 48, "minimum_valid_share": 0.3},
    "parts": [{"walls": ["ledge"], "noise": ["low"], "sizes": ["large"], "train": 1, "val": 1, "test": 1}],
}
WIDTH, HEIGHT = 48, 32


def make_materials(folder: Path, *, diagnosed: bool = True) -> None:
    """Make all good inputs.

    They are site.yaml, set.yaml; run/, set/, measurement/, raw/, pair/, detector/, diagnosis/; truth.json, found.json. diagnosed:
    whether to make diagnosis/, which takes longest. Raises RuntimeError if a command fails on them.
    """
    _make_all(folder, SITE, SET, 4_000)
    if diagnosed:
        _called("gap", str(folder / "measurement"), "--out", str(folder / "diagnosis"))


def make_small(folder: Path) -> None:
    """Make good inputs of a few hundred pixels and points, in seconds.

    diagnosis/ and events/ are made as their commands would write them.
    """
    site = {**SITE, "epochs": 1, "wall": {**SITE["wall"], "width_m": 4.0, "height_m": 3.0, "resolution_m": 0.2}}
    site |= {"scanner": {"azimuth_step_rad": 0.01, "zenith_step_rad": 0.01}, "rockfall": {"count": 2, "size_m": 0.5}}
    wall = {key: value for key, value in site.items() if key not in ("seed", "epochs", "calibration")}
    part = {**SET["parts"][0], "train": 1, "val": 1, "test": 0}
    small = {**SET, "walls": {"ledge": wall}, "tiles": {**SET["tiles"], "size_px": 16}, "parts": [part], "validation_region": 0.0}
    _make_all(folder, site, small, 400)
    _diagnosis(folder / "diagnosis", read_points(folder / "raw/scan.ply").points)
    event = Event("difference_001.tif", 1, 1.0, 1.0, 0.5, 0.5, 0.2, 0.1, 0.05, 0.01, 0.97)
    write_events([event], folder / "events/events_0.9.csv")


def _make_all(folder: Path, site: dict[str, Any], matrix: dict[str, Any], points: int) -> None:
    """Make all but diagnosis/ and events/, from the configs of a site and of a set; points: number in each measurement."""
    folder.mkdir(parents=True)
    (folder / "site.yaml").write_text(yaml.safe_dump(site))
    (folder / "set.yaml").write_text(yaml.safe_dump(matrix))
    _coco(folder)
    shutil.copytree(configs_folder() / "detectors/default", folder / "detector")
    for name, sensor in (("measurement", "tls"), ("pair", "stereo")):
        make(Case(0, (7, 1), "one", sensor, (), points, points), folder / name, folder / f"{name}_truth.json")
    _raw(folder)
    _called("simulate", "--sensor", "tls", "--config", str(folder / "site.yaml"), "--out", str(folder / "run"))
    _called("dataset", str(folder / "set.yaml"), "--out", str(folder / "set"))


def _diagnosis(folder: Path, points: FloatArray) -> None:
    """Write what `view` reads of a diagnosis."""
    extra = {"residual_m": points[:, 0] * 1e-4, "held_out": np.arange(len(points), dtype=np.uint8) % 2}
    for name in ("before", "after"):
        write_laz(folder / f"{name}.laz", PointCloud(points, extra=extra))
    change = {"bbox_m": [*points[0], *(points[0] + 1)], "volume_m3": 0.12}
    write_json(folder / "gap.json", {"schema": 1, "sensor": "tls", "verdict": "named", "scene_changes": [change]})


def _called(*words: str) -> None:
    if main([*words, "--quiet"]):
        raise RuntimeError(f"a good input fails: scarpsim {' '.join(words)}")


def _raw(folder: Path) -> None:
    """Write raw/: the points of measurement/ and its wall, both in the scanner's frame."""
    given = yaml.safe_load((folder / "measurement/measurement.yaml").read_text())["scanner"]
    position, rotation = np.array(given["position_m"]), np.array(given["rotation"])
    (folder / "raw").mkdir()
    shutil.copy(folder / "measurement/scan.ply", folder / "raw/scan.ply")
    wall = read_ply(folder / "measurement/wall.ply")
    local = np.einsum("ji,nj->ni", rotation, wall.vertices - position)
    write_ply(folder / "raw/wall.ply", TriangleMesh(local, wall.faces))


def _coco(folder: Path) -> None:
    """Write truth.json, with two blocks in each of two images, and found.json, the same with scores."""
    images = [
        {"id": 1 + number, "file_name": f"{number}.tif", "width": WIDTH, "height": HEIGHT, "noise": "low"} for number in range(2)
    ]
    annotations = []
    for number in range(4):
        x, y = 4 + 20 * (number % 2), 6
        rle = run_length_encoding(np.ones((8, 10), bool), y, x, (HEIGHT, WIDTH))
        shape = {"segmentation": rle, "bbox": [x, y, 10, 8], "area": 80, "iscrowd": 0}
        annotations.append({"id": 1 + number, "image_id": 1 + number // 2, "category_id": 1, **shape})
    content = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "block"}]}
    (folder / "truth.json").write_text(json.dumps(content))
    scored = [{**each, "score": 0.97} for each in annotations]
    (folder / "found.json").write_text(json.dumps({**content, "annotations": scored}))

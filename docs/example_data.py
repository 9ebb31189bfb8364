"""Data to try the how-tos on where there are none of one's own; simulated, so that the truth is known.

python docs/example_data.py site DIR           wall.ply in survey coordinates and cameras.xml, Metashape's
python docs/example_data.py measurement DIR    a laser scan that the model beside it does not explain, for `scarpsim gap`
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from pipeline.formats.cameras.metashape import write_metashape
from pipeline.formats.meshes.ply import write_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.cameras.camera import axis_rotation
from sensors.effects.base import Effect
from sensors.effects.range_incidence_bias import RangeIncidenceBias
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import PoseSigma, RigConfig, StationConfig, Target
from sensors.models.sensor_model import TlsModel

ORIGIN = np.array([345200.0, 6389450.0, 120.0])
"""Where the example stands: easting, northing, height, m."""
TRUTH = (RangeIncidenceBias(coefficient_m=0.006),)
"""What the example's scanner does and its model does not know."""


def site(folder: Path, resolution_m: float = 0.06) -> None:
    """Make a wall of 24 x 15 m that looks to the south-east, and a pair of photographs from 50 m with a base of 13 m."""
    wall = ProceduralWall(style="bulga", width_m=24.0, height_m=15.0, resolution_m=resolution_m).mesh(KeyedRandom(7))
    wall = wall.with_vertices(wall.vertices @ axis_rotation(2, np.radians(35.0)).T + ORIGIN)
    pair = RigConfig(distance_m=50.0, base_m=13.0).place(Target(wall))
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / "wall.ply", wall)
    write_metashape(folder / "cameras.xml", {"DSC_0001": pair.left, "DSC_0002": pair.right})


def measurement(folder: Path, step_rad: float = 0.004, effects: tuple[Effect, ...] = TRUTH) -> None:
    """Make a scan from 40 m, its pose known to 2 mm and 30 microradians, with `effects` that model.yaml does not name."""
    wall = ProceduralWall(style="glendale", width_m=40.0, height_m=26.0, resolution_m=0.2).mesh(KeyedRandom(3))
    frame = WallFrame.fit(wall.vertices, Target(wall).stand(40.0, 1.6))
    known = TlsModel()
    pose, sigma = StationConfig(distance_m=40.0).place(Target(wall)), PoseSigma(position_m=0.002, rotation_rad=3e-5)
    scanner = ScannerConfig(azimuth_step_rad=step_rad, zenith_step_rad=step_rad)
    caster = RayCaster(wall.with_vertices(frame.to_wall(wall.vertices)))
    model = known.model_copy(update={"effects": effects})
    seen = LaserScanner.aimed(pose, frame, caster.mesh.vertices, scanner, model, False, sigma).observe(caster, KeyedRandom(11))
    assert seen.intensity is not None and seen.gps_time is not None  # noqa: PT018 (a scanner records both)
    folder.mkdir(parents=True, exist_ok=True)
    points = frame.to_world(seen.points[seen.valid])
    write_laz(folder / "scan.laz", PointCloud(points, seen.intensity[seen.valid], seen.gps_time[seen.valid]))
    write_ply(folder / "wall.ply", wall)
    _write_yaml(folder / "model.yaml", {"sensor": "tls", "noise": known.noise.model_dump(), "effects": []})
    _write_yaml(folder / "measurement.yaml", {
        "sensor": "tls", "reference": "wall.ply", "points": "scan.laz", "frame": "world", "model": "model.yaml",
        "scanner": {"position_m": pose[0].tolist(), "rotation": pose[1].tolist()},
    })  # fmt: skip


def _write_yaml(path: Path, values: dict[str, object]) -> None:
    path.write_text(yaml.safe_dump(values, sort_keys=False, default_flow_style=None))


KINDS: dict[str, Callable[[Path], None]] = {"site": site, "measurement": measurement}

if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in KINDS:
        sys.exit(__doc__)
    KINDS[sys.argv[1]](Path(sys.argv[2]))

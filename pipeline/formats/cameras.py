"""A stereo pair's calibration in the project's own YAML: the sections `left` and `right` of cameras.yaml."""

from __future__ import annotations

from pathlib import Path

from scene.config import Config, load_yaml, parse
from sensors.camera import CameraConfig, CameraPair


class PairConfig(Config):
    """A stereo pair, camera by camera."""

    left: CameraConfig
    right: CameraConfig

    def pair(self) -> CameraPair:
        """The cameras, world frame."""
        return CameraPair(self.left.camera(), self.right.camera())


def read_cameras_yaml(path: Path) -> CameraPair:
    """Read cameras.yaml: nominal calibration and pose of `left` and `right`, world frame."""
    return parse(PairConfig, load_yaml(path), str(path)).pair()

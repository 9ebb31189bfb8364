"""Read and write COLMAP's text model (camera poses and calibrations), and its depth and normal maps.

cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS. images.txt, two lines for each image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID
NAME, then its keypoints (which may be empty). points3D.txt: POINT3D_ID X Y Z R G B ERROR and the track as (IMAGE_ID, KEYPOINT)
pairs (COLMAP documentation, "Output Format"). Poses map the world to the camera, the quaternion's scalar comes first, and the
centre of the top-left pixel is (0.5, 0.5). The camera models are OpenCV's: see pipeline.formats.cameras.opencv.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.cameras.opencv import OpencvInterior, shared_distortion
from pipeline.formats.files.atomic import write_bytes, write_text
from scene.common.errors import InputError
from scene.common.regular_file import read_text
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, Pose

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Parameters of those COLMAP models that our camera model covers (if k4, k5 and k6 are zero), in the order of cameras.txt."""
_PLACE = ("f", "fx", "fy", "cx", "cy")
"""Parameters that are not distortion."""
_LARGEST = 1e12
"""Largest coordinate, pixel or lens parameter, so that squares and products stay finite."""
_MAP_HEADER = re.compile(rb"(\d+)&(\d+)&(\d+)&")


def read_colmap(folder: Path) -> dict[str, Camera]:
    """Read the cameras (calibration and pose) of a COLMAP text model by image name, world frame.

    folder: has the model's text files. Raises InputError if a file is missing or malformed, or has a camera model or parameter
    that scarpsim's cameras lack.
    """
    from scipy.spatial.transform import Rotation

    interiors = {words[0]: (words, where) for words, where in _records(folder / "cameras.txt", 5, 1)}
    cameras = {}
    for words, where in _records(folder / "images.txt", 10, 2):
        if words[8] not in interiors:
            raise InputError(
                f"the image names the camera {words[8]}, which is not in cameras.txt",
                where=where,
                remedy="export cameras.txt and images.txt of the same model",
            )
        quaternion, translation = np.split(_numbers(words[1:8], where), [4])
        if np.abs(quaternion).max() < 1e-9:
            raise InputError(
                "the rotation (quaternion) of the image is zero", where=where, remedy="export the model again as text"
            )
        rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix().T
        cameras[" ".join(words[9:])] = _camera(*interiors[words[8]], (-rotation @ translation, rotation))
    return cameras


def write_colmap(folder: Path, cameras: Mapping[str, Camera], points: FloatArray | None = None) -> None:
    """Write cameras as a COLMAP text model, with which COLMAP can fuse depth maps.

    Parameters
    ----------
    folder : Folder to write.
    cameras : Cameras by image name, world frame.
    points : (n, 3) points seen by every image, world frame, m. COLMAP's fusion finds overlapping images by their common points.

    Raises
    ------
    InputError
        If COLMAP has no camera model with a parameter that is not zero (b2, k4).
    """
    from scipy.spatial.transform import Rotation

    points = np.zeros((0, 3)) if points is None else points
    interiors, images, track = [], [], []
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        interiors.append(f"{number} {_interior(camera, f'{folder}: {name}')}")
        world_to_camera = camera.rotation.T
        quaternion = Rotation.from_matrix(world_to_camera).as_quat(scalar_first=True)
        pose = _text([*quaternion, *(-world_to_camera @ camera.position)])
        images += [f"{number} {pose} {number} {name}", _keypoints(camera, points)]
        track.append(number)
    tracks = [" ".join(f"{image} {index}" for image in track) for index in range(len(points))]
    landmarks = [f"{index + 1} {_text(point)} 128 128 128 0 {tracks[index]}" for index, point in enumerate(points)]
    for file, lines in (("cameras.txt", interiors), ("images.txt", images), ("points3D.txt", landmarks)):
        write_text(folder / file, "".join(f"{line}\n" for line in lines))


def write_map(path: Path, values: NDArray[np.floating]) -> None:
    """Write a depth map (h, w) or a normal map (h, w, 3), `values`, to a file in COLMAP's format.

    The file has a header `w&h&channels&`, then float32 values, channel by channel.
    """
    channels = values[..., None] if values.ndim == 2 else values
    height, width, depth = channels.shape
    planes = np.ascontiguousarray(np.moveaxis(channels, 2, 0), dtype="<f4")
    write_bytes(path, f"{width}&{height}&{depth}&".encode() + planes.tobytes())


def read_map(path: Path) -> NDArray[np.float32]:
    """Read a depth map (h, w) or a normal map (h, w, 3) in COLMAP's format; raise InputError for any other file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing file that you may read",
        ) from None
    header = _MAP_HEADER.match(data)
    width, height, depth = (int(number) for number in header.groups()) if header else (0, 0, 0)
    if header is None or len(data) != header.end() + 4 * width * height * depth:
        raise InputError(
            "the file is not a complete depth or normal map of COLMAP",
            where=str(path),
            remedy="compute the depth and normal maps again with COLMAP",
        )
    planes = np.frombuffer(data, "<f4", offset=header.end()).reshape(depth, height, width)
    return planes[0] if depth == 1 else np.moveaxis(planes, 0, 2)


def _records(path: Path, words: int, stride: int) -> list[tuple[list[str], str]]:
    """Return the words of every `stride`-th line that is not a comment, and its place in the file.

    Raises InputError if a line has fewer than `words` words.
    """
    remedy = "export the model as text (colmap model_converter --output_type TXT)"
    lines = read_text(path, remedy=remedy).splitlines()
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if not line.startswith("#")]
    if stride == 1:
        numbered = [(number, line) for number, line in numbered if line.strip()]
    while numbered and not numbered[-1][1].strip():
        numbered.pop()
    records = [(line.split(), f"{path}, line {number}") for number, line in numbered[::stride]]
    for found, where in records:
        if len(found) < words:
            raise InputError(
                f"the line has {len(found)} words",
                where=where,
                allowed=f"at least {words}",
                remedy="correct the line, or export the model again as text",
            )
    return records


def _camera(words: list[str], where: str, pose: Pose) -> Camera:
    """Return the camera of a line of cameras.txt."""
    model = words[1]
    if model not in MODELS:
        raise InputError(
            f"the camera model {model} is not supported",
            where=where,
            allowed=", ".join(MODELS),
            remedy="undistort the images in COLMAP, or estimate one of these models",
        )
    values = _numbers(words[2:], where)
    if len(values) != 2 + len(MODELS[model]) or min(values[:3]) <= 0:
        raise InputError(
            f"the values of the camera model {model} are incomplete, or its size or focal length is not above 0",
            where=where,
            allowed=f"width, height and {', '.join(MODELS[model])}",
            remedy="export the model again as text",
        )
    named = dict(zip(MODELS[model], values[2:].tolist(), strict=True))
    distortion = shared_distortion({name: value for name, value in named.items() if name not in _PLACE}, where)
    fx, fy = named.get("fx", named.get("f", 0.0)), named.get("fy", named.get("f", 0.0))
    return OpencvInterior(fx, fy, named["cx"], named["cy"], **distortion).camera(values[0], values[1], where, pose)


def _interior(camera: Camera, where: str) -> str:
    """Return MODEL WIDTH HEIGHT PARAMS for the smallest of COLMAP's models that covers the camera."""
    interior = OpencvInterior.of(camera, where)
    distorted = any(getattr(interior, name) != 0 for name in ("k1", "k2", "p1", "p2"))
    model = "FULL_OPENCV" if interior.k3 != 0 else "OPENCV" if distorted else "PINHOLE"
    return f"{model} {camera.width} {camera.height} {_text([getattr(interior, name, 0.0) for name in MODELS[model]])}"


def _keypoints(camera: Camera, points: FloatArray) -> str:
    """Return the second line of an image: X Y POINT3D_ID of every point."""
    local = (points - camera.position) @ camera.rotation
    u, v = camera.pixel(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
    return " ".join(f"{_text(pixel)} {index}" for index, pixel in enumerate(zip(u, v, strict=True), start=1))


def _text(values: object) -> str:
    """Format numbers with all their digits."""
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))


def _numbers(words: list[str], where: str) -> FloatArray:
    """Parse finite numbers, or raise InputError."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.array([np.nan])
    if not (np.abs(values) <= _LARGEST).all():
        raise InputError(
            f"the values '{' '.join(words)[:60]}' are not all numbers in the allowed range",
            where=where,
            allowed=f"numbers up to {_LARGEST:g}",
            remedy="correct the line, or export the model again as text",
        )
    return values

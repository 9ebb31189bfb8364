"""Cameras from Agisoft Metashape's XML (File > Export > Export Cameras).

A sensor may hold two calibrations: the one of class "adjusted" counts; missing tags are 0. A camera without a transform is not
aligned. A transform is row-major, camera to chunk; the component's or else the chunk's transform (s, R, t) leads on:
x_world = s R x_chunk + t.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scene.errors import InputError
from scene.mesh import FloatArray
from sensors.camera import Camera

_TAGS = {"f": "f_px", "cx": "cx_px", "cy": "cy_px"} | {name: name for name in ("b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")}


@dataclass(frozen=True)
class MetashapeCameras:
    """Cameras by label, world frame, and the labels of those that were not aligned."""

    cameras: dict[str, Camera]
    unaligned: tuple[str, ...]


def read_metashape(path: Path) -> MetashapeCameras:
    """Read all frame cameras of a Metashape camera XML.

    Raises InputError where the file is no such XML or a sensor is not a frame camera with a calibration.
    """
    chunk = _chunk(path)
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iter("sensor")}
    to_world = {component.get("id", ""): _similarity(component, path) for component in chunk.iter("component")}
    default = _similarity(chunk, path)
    cameras, unaligned = {}, []
    for element in chunk.iter("camera"):
        label, transform = element.get("label", element.get("id", "")), element.findtext("transform")
        if transform is None:
            unaligned.append(label)
            continue
        pose = to_world.get(element.get("component_id", ""), default) @ _numbers(
            transform, 16, f"{path}: camera {label}"
        ).reshape(4, 4)
        sensor = sensors.get(element.get("sensor_id", ""))
        if sensor is None:
            raise InputError(f"camera '{label}' names no sensor of the file", where=str(path))
        cameras[label] = _camera(sensor, pose, f"{path}: sensor {sensor.get('label', sensor.get('id'))}")
    return MetashapeCameras(cameras, tuple(unaligned))


def _chunk(path: Path) -> ElementTree.Element:
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise InputError("declares entities, which Metashape never does", where=str(path))
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"is not valid XML ({error})", where=str(path)) from None
    chunk = root.find("chunk") if root.tag == "document" else None
    if chunk is None:
        raise InputError("is no Metashape camera XML", where=str(path), remedy="export it with File > Export > Export Cameras")
    return chunk


def _similarity(element: ElementTree.Element, path: Path) -> FloatArray:
    """(4, 4) the transform tag of a chunk or component, the identity where it has none."""
    matrix = np.eye(4)
    transform = element.find("transform")
    if transform is None:
        return matrix
    where = f"{path}: transform"
    scale = float(_numbers(transform.findtext("scale", "1"), 1, where)[0])
    matrix[:3, :3] = scale * _numbers(transform.findtext("rotation", "1 0 0 0 1 0 0 0 1"), 9, where).reshape(3, 3)
    matrix[:3, 3] = _numbers(transform.findtext("translation", "0 0 0"), 3, where)
    return matrix


def _camera(sensor: ElementTree.Element, pose: FloatArray, where: str) -> Camera:
    if sensor.get("type", "frame") != "frame":
        raise InputError(f"has the model '{sensor.get('type')}'", where=where, allowed="frame")
    calibrations = sensor.findall("calibration")
    adjusted = [calibration for calibration in calibrations if calibration.get("class") == "adjusted"] or calibrations
    resolution = sensor.find("resolution")
    if resolution is None or not adjusted or adjusted[0].findtext("f") is None:
        raise InputError("has no resolution or no calibration with f", where=where)
    width, height = int(resolution.get("width", "0")), int(resolution.get("height", "0"))
    interior = {name: float(_numbers(adjusted[0].findtext(tag, "0"), 1, where)[0]) for tag, name in _TAGS.items()}
    left, _, right = np.linalg.svd(pose[:3, :3])  # the nearest rotation: takes out the similarity's scale
    camera = Camera(width, height, **interior, position=pose[:3, 3], rotation=left @ right)
    camera.check_invertible()
    return camera


def _numbers(text: str, count: int, where: str) -> FloatArray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"expected {count} numbers, got '{' '.join(text.split())[:60]}'", where=where)
    return values

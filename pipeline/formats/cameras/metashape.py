"""Read and write cameras and calibrations in Agisoft Metashape's XML, whose camera model is the same as ours.

Camera XML (File > Export > Export Cameras): a sensor may have two calibrations, of which the one of class "adjusted" counts;
missing tags are 0. A camera without a transform is not aligned. A transform is row-major, camera to chunk. The similarity (s, R,
t) of the camera's component, or of the chunk if the component has none, follows: x_world = s R x_chunk + t. In a chunk with a
projected coordinate system (tag `reference`) the result is geocentric and is converted to projected coordinates. A project (.psx)
holds the same of its active chunk. Whatever changes the rays but has no place in the camera model is refused: rolling shutter
motion, and lens parameters beyond ours.

Calibration XML (Tools > Camera Calibration > Save): one interior orientation.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.formats.cameras.geocentric import Projection, is_geocentric
from pipeline.formats.cameras.metashape_project import active_chunk, is_project
from pipeline.formats.files.atomic import write_bytes
from pipeline.formats.files.xml_file import read_root
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, checked_camera

_TAGS = {"f": "f_px", "cx": "cx_px", "cy": "cy_px"} | {name: name for name in ("b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")}
"""Name in our camera model of each calibration tag."""
_PARAMETER = re.compile(r"[a-z]\d")
"""Pattern of lens parameter tags: k5, p3, b3."""
_LARGEST = 1e12
"""Largest coordinate, pixel or lens parameter, so that products stay finite."""


@dataclass(frozen=True)
class MetashapeCameras:
    """Cameras with poses that a file of Metashape or COLMAP contains.

    cameras: by label, world frame. unaligned: labels of cameras without an estimated pose. rigged: labels of those whose pose
    is relative to another camera of a rig.
    """

    cameras: dict[str, Camera]
    unaligned: tuple[str, ...]
    rigged: tuple[str, ...] = ()


def read_metashape(path: Path) -> MetashapeCameras:
    """Read the calibration and pose, world frame, of all frame cameras in a file of Metashape.

    path: a camera XML, or a project, of which the active chunk is read. Raises InputError if the file is neither, the sensor of
    an aligned camera is not a frame camera with a calibration, or two cameras have the same label.
    """
    chunk = _chunk(path)
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors//sensor")}
    default = _similarity(chunk, path)
    to_world = {
        component.get("id", ""): default if component.find("transform") is None else _similarity(component, path)
        for component in chunk.iterfind("components//component")
    }
    reference = (chunk.findtext("reference") or "").strip()
    projection = None if _is_metric(reference) else Projection(reference, str(path))
    cameras: dict[str, Camera] = {}
    unaligned: list[str] = []
    rigged: list[str] = []
    for element in chunk.iterfind("cameras//camera"):
        label, transform = element.get("label", element.get("id", "")), element.findtext("transform")
        if transform is None:
            (rigged if element.get("master_id") else unaligned).append(label)
            continue
        _check_shutter(element, f"{path}: camera {label}")
        if label in cameras:
            raise InputError(f"two cameras are labelled '{label}'", where=str(path), remedy="rename one of them in Metashape")
        sensor = sensors.get(element.get("sensor_id", ""))
        if sensor is None:
            raise InputError(
                f"the sensor of camera '{label}' is not in the file",
                where=str(path),
                remedy="export the cameras again with File > Export > Export Cameras",
            )
        in_chunk = _numbers(transform, 16, f"{path}: camera {label}").reshape(4, 4)
        pose = to_world.get(element.get("component_id", ""), default) @ in_chunk
        if projection is not None and is_geocentric(pose[:3, 3]):
            pose = projection.pose(pose)
        cameras[label] = _sensor_camera(sensor, pose, f"{path}: sensor {sensor.get('label', sensor.get('id'))}")
    return MetashapeCameras(cameras, tuple(unaligned), tuple(rigged))


def write_metashape(path: Path, cameras: Mapping[str, Camera]) -> None:
    """Write cameras by label, world frame, as a camera XML that Metashape imports (File > Import > Import Cameras)."""
    document = ElementTree.Element("document", version="2.0.0")
    chunk = ElementTree.SubElement(document, "chunk", label="scarpsim", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(cameras)))
    components = ElementTree.SubElement(chunk, "components", next_id="1", active_id="0")
    elements = ElementTree.SubElement(chunk, "cameras", next_id=str(len(cameras)), next_group_id="0")
    transform = ElementTree.SubElement(ElementTree.SubElement(components, "component", id="0", label="Component 1"), "transform")
    _texts(transform, {"rotation": np.eye(3), "translation": np.zeros(3), "scale": np.ones(1)})
    for number, (label, camera) in enumerate(cameras.items()):
        sensor = ElementTree.SubElement(sensors, "sensor", id=str(number), label=label, type="frame")
        size = {"width": str(camera.width), "height": str(camera.height)}
        ElementTree.SubElement(sensor, "resolution", size)
        calibration = ElementTree.SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
        ElementTree.SubElement(calibration, "resolution", size)
        _write_interior(calibration, camera)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation, camera.position
        identity = {"id": str(number), "sensor_id": str(number), "component_id": "0", "label": label, "enabled": "true"}
        _texts(ElementTree.SubElement(elements, "camera", identity), {"transform": pose})
    _write(path, document)


def read_calibration(path: Path) -> Camera:
    """Read a camera's interior orientation from Metashape's calibration XML; its pose is the origin."""
    root = read_root(path)
    if root.tag != "calibration":
        raise InputError(
            f"the file is not a calibration XML of Metashape (its root is <{root.tag}>)",
            where=str(path),
            remedy="export the calibration with Tools > Camera Calibration > Save",
        )
    if (projection := root.findtext("projection", "frame")) != "frame":
        raise InputError(
            f"the calibration has the projection '{projection}'",
            where=str(path),
            allowed="frame",
            remedy="use a camera of type frame in Metashape",
        )
    width, height = (_whole(root.findtext(tag, "0"), str(path)) for tag in ("width", "height"))
    return _camera(root, (width, height), np.eye(4), str(path))


def write_calibration(path: Path, camera: Camera) -> None:
    """Write the interior orientation of a camera as a calibration XML, which Metashape imports."""
    root = ElementTree.Element("calibration")
    for tag, text in (("projection", "frame"), ("width", str(camera.width)), ("height", str(camera.height))):
        ElementTree.SubElement(root, tag).text = text
    _write_interior(root, camera)
    _write(path, root)


def _chunk(path: Path) -> ElementTree.Element:
    """Return the chunk of a camera XML, or the active chunk of a project."""
    if is_project(path):
        return active_chunk(path)
    root = read_root(path)
    chunk = root.find("chunk") if root.tag == "document" else None
    if chunk is None:
        raise InputError(
            "the file is not a Metashape camera XML",
            where=str(path),
            remedy="export the cameras with File > Export > Export Cameras",
        )
    return chunk


def _is_metric(reference: str) -> bool:
    """Whether a chunk's coordinate system, in WKT, is already that of its transforms: none, a local or a geocentric one."""
    return not reference or reference.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS", "GEOCCS"))


def _similarity(element: ElementTree.Element, path: Path) -> FloatArray:
    """Return the (4, 4) transform of a chunk or component, the identity if it has none."""
    matrix = np.eye(4)
    transform = element.find("transform")
    if transform is None:
        return matrix
    where = f"{path}: transform"
    scale = float(_numbers(transform.findtext("scale", "1"), 1, where)[0])
    if scale <= 0:
        raise InputError(
            f"the transform has the scale {scale:g}",
            where=where,
            allowed="greater than 0",
            remedy="export the cameras again with File > Export > Export Cameras",
        )
    matrix[:3, :3] = scale * _numbers(transform.findtext("rotation", "1 0 0 0 1 0 0 0 1"), 9, where).reshape(3, 3)
    matrix[:3, 3] = _numbers(transform.findtext("translation", "0 0 0"), 3, where)
    return matrix


def _sensor_camera(sensor: ElementTree.Element, pose: FloatArray, where: str) -> Camera:
    """Return the camera of a sensor; pose: (4, 4) camera to world, possibly with a scale."""
    calibrations = sensor.findall("calibration")
    adjusted = [calibration for calibration in calibrations if calibration.get("class") == "adjusted"] or calibrations
    resolution = sensor.find("resolution")
    if resolution is None or not adjusted:
        raise InputError(
            "the sensor has no resolution or no calibration", where=where, remedy="align the cameras before the export"
        )
    for kind in (sensor.get("type", "frame"), adjusted[0].get("type", "frame")):
        if kind != "frame":
            raise InputError(
                f"the sensor has the model '{kind}'",
                where=where,
                allowed="frame",
                remedy="use a camera of type frame in Metashape",
            )
    width, height = (_whole(resolution.get(side, "0"), where) for side in ("width", "height"))
    return _camera(adjusted[0], (width, height), pose, where)


def _check_shutter(camera: ElementTree.Element, where: str) -> None:
    """Raise InputError for a camera aligned with rolling shutter compensation, whose rows have different poses."""
    for motion in camera.iter("rolling_shutter"):
        if any(value != 0 for value in _numbers_of(motion.itertext())):
            raise InputError(
                "the camera was aligned with rolling shutter compensation: each row has its own pose, which is not supported",
                where=where,
                allowed="one pose for each picture",
                remedy="switch off the compensation in Metashape's camera calibration, align the cameras again, and export them",
            )


def _check_parameters(calibration: ElementTree.Element, where: str) -> None:
    """Raise InputError for a non-zero lens parameter that our camera model lacks, such as p3 of old versions."""
    for child in calibration:
        unknown = child.tag not in _TAGS and _PARAMETER.fullmatch(child.tag) is not None
        if unknown and any(value != 0 for value in _numbers_of([child.text or ""])):
            allowed = ", ".join(_TAGS)
            raise InputError(
                f"the calibration has the lens parameter {child.tag} = {(child.text or '').strip()[:20]}, which is not supported",
                where=where,
                allowed=allowed,
                remedy=f"fix {child.tag} at 0 in Metashape and optimise again",
            )


def _numbers_of(texts: Iterable[str]) -> list[float]:
    """Return the numbers in some texts, with NaN for other words."""
    found = []
    for word in " ".join(texts).split():
        try:
            found.append(float(word))
        except ValueError:
            found.append(float("nan"))
    return found


def _camera(calibration: ElementTree.Element, size: tuple[int, int], pose: FloatArray, where: str) -> Camera:
    """Return the camera of a calibration."""
    _check_parameters(calibration, where)
    interior = {name: float(_numbers(calibration.findtext(tag, "0"), 1, where)[0]) for tag, name in _TAGS.items()}
    if interior["f_px"] <= 0 or min(size) <= 0:
        raise InputError(
            "the calibration has no frame size or no focal length f",
            where=where,
            allowed="width, height and f greater than 0",
            remedy="align the cameras in Metashape, and export them again",
        )
    left, scales, right = np.linalg.svd(pose[:3, :3])  # the nearest rotation, without the similarity's scale
    if np.linalg.det(left @ right) < 0 or np.ptp(scales) > 1e-6 * scales[0]:
        raise InputError(
            "the camera's transform is not a rotation with one scale",
            where=where,
            remedy="export the cameras again with File > Export > Export Cameras",
        )
    return checked_camera(where, size, interior, (pose[:3, 3], left @ right))


def _write_interior(element: ElementTree.Element, camera: Camera) -> None:
    """Write the calibration's tags except those that are zero, as Metashape does."""
    values = {tag: float(getattr(camera, name)) for tag, name in _TAGS.items()}
    _texts(element, {tag: np.array([value]) for tag, value in values.items() if value != 0})


def _texts(parent: ElementTree.Element, values: Mapping[str, FloatArray]) -> None:
    """Add children with numbers in row-major order, with all their digits."""
    for tag, array in values.items():
        ElementTree.SubElement(parent, tag).text = " ".join(repr(float(number)) for number in array.ravel())


def _write(path: Path, root: ElementTree.Element) -> None:
    """Write an XML document."""
    ElementTree.indent(root)
    write_bytes(path, ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n")


def _whole(text: str, where: str) -> int:
    """Parse a whole number."""
    value = float(_numbers(text, 1, where)[0])
    if value != int(value):
        raise InputError(f"'{text}' is not a whole number of pixels", where=where, remedy="export the file again from Metashape")
    return int(value)


def _numbers(text: str, count: int, where: str) -> FloatArray:
    """Parse `count` finite numbers, or raise InputError."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not (np.abs(values) <= _LARGEST).all():
        raise InputError(
            f"the value must have {count} numbers, but is '{' '.join(text.split())[:60]}'",
            where=where,
            remedy="export the file again from Metashape",
        )
    return values

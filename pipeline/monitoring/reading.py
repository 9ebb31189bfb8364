"""Read epochs: scans, clouds, meshes and elevation models, folders of scans, and runs of `simulate`."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.files.checksum import sha256
from pipeline.formats.points.laz_chunks import CHUNK, count_points, read_chunks
from pipeline.formats.points.points import SUFFIXES
from pipeline.formats.records.result_records import RUN_FILE, read_run
from pipeline.measurement.reference import DEMS, is_cloud, reference_from_dem
from pipeline.measurement.scans import RawScan, read_scans
from pipeline.monitoring.gridding import POINTS_AT_ONCE, SAMPLE, WallPoints
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.times import SIDECAR, EpochTime, check_order, time_of
from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.bounds import bounding_box
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.walls.imported import read_mesh

_BEFORE_M = 100.0
"""How far before the wall of a run the sensor is taken to stand: only the side counts."""
WHOLE_POINTS = 4_000_000
"""Points of an epoch up to which LAS and LAZ files are read at once."""
_SAMPLE = 1_000_000
"""Points of larger ones that are kept for the frame, the pixel and ICP."""
_KEPT_POINTS, _STEP_M = 50_000_000, 1e-5
"""Points of an epoch up to which they stay in memory, as integers in steps of so many metres (600 MB)."""
_LAS = (".las", ".laz")
_ANY = (*SUFFIXES, *DEMS, ".obj", ".stl", ".glb", ".off")


@dataclass(frozen=True)
class EpochSource:
    """The files from which one epoch is read, and its time.

    Attributes
    ----------
    path : Path
        The path that the user gave.
    files : tuple of Path
        The one file, or the scans of the epoch.
    time : EpochTime
        When it was measured.
    run : dict or None
        Content of run.json if the epoch belongs to a run of `simulate`.
    """

    path: Path
    files: tuple[Path, ...]
    time: EpochTime
    run: dict[str, Any] | None = field(default=None, repr=False)

    @property
    def name(self) -> str:
        """Name of the epoch in reports and messages: that of its file or folder."""
        return self.path.name if self.run is None else f"{self.path.parent.name}/{self.path.name}"

    @property
    def is_surface(self) -> bool:
        """Whether a file of the epoch is a mesh or an elevation model, not the points of a scan."""
        return self.run is None and any(file.suffix.lower() in DEMS or not is_cloud(file) for file in self.files)

    def checksums(self) -> dict[str, str]:
        """Return the SHA-256 checksum of each file of the epoch, by its path: it tells whether a file was changed."""
        return {str(file): sha256(file) for file in self.files}


@dataclass(frozen=True)
class LargeFiles:
    """The LAS and LAZ files of an epoch with many points, which are read chunk by chunk.

    Attributes
    ----------
    files : tuple of Path
        The files.
    unit : str or None
        Unit of the coordinates given by the user; None: as the files state.
    count : int
        Number of points, without those that the files flag as withheld, synthetic or noise.
    first : (n, 3) array
        The first points in the order of the files, survey coordinates, m.
    bounds : (2, 3) array
        Smallest and largest coordinates of all points, survey coordinates, m.
    kept : tuple of (n, 3) int32 arrays
        All points as steps of 0.01 mm from the first one, if they fit into memory easily; else empty.
    """

    files: tuple[Path, ...]
    unit: str | None
    count: int
    first: FloatArray
    bounds: FloatArray
    kept: tuple[NDArray[np.int32], ...] = ()

    def chunks(self) -> Iterator[FloatArray]:
        """Yield all points of the files in chunks (n, 3), survey coordinates, m."""
        if self.kept:
            return (steps * _STEP_M + self.first[0] for steps in self.kept)
        return itertools.chain.from_iterable(read_chunks(file, self.unit) for file in self.files)


@dataclass(frozen=True)
class EpochData:
    """Points of an epoch as read from its files, and what these state of sensor and coordinate system.

    Attributes
    ----------
    points : (n, 3) array
        Points, or the vertices of a mesh, survey coordinates, m. For large files a sample, spread over the files.
    mesh : TriangleMesh or None
        The surface, survey coordinates, m, if the files contain one.
    position : (3,) array or None
        Position of the sensor, survey coordinates, m, if the files state it.
    crs : str
        WKT of the coordinate system; empty if it is not stated.
    notes : tuple of str
        Remarks on the files for the user.
    large : LargeFiles or None
        The files if they are too large for memory; the points are then read from them again, chunk by chunk.
    """

    points: FloatArray
    mesh: TriangleMesh | None = None
    position: FloatArray | None = None
    crs: str = ""
    notes: tuple[str, ...] = ()
    large: LargeFiles | None = None

    @property
    def count(self) -> int:
        """Number of points in the epoch's files."""
        return len(self.points) if self.large is None else self.large.count

    @property
    def in_order(self) -> FloatArray:
        """Points (n, 3) in the order of the file, survey coordinates, m; of large files only the first ones."""
        return self.points if self.large is None else self.large.first

    @property
    def bounds(self) -> FloatArray:
        """Smallest and largest coordinates of all points, (2, 3), survey coordinates, m."""
        return bounding_box(self.points) if self.large is None else self.large.bounds

    def chunks(self) -> Iterator[FloatArray]:
        """Yield all points of the epoch in chunks (n, 3), survey coordinates, m."""
        return iter(np.array_split(self.points, -(-len(self.points) // CHUNK))) if self.large is None else self.large.chunks()

    def wall_points(self, frame: WallFrame, gsd_m: float, *, several: bool = False) -> WallPoints:
        """Return the epoch's points in the wall frame, m.

        If the epoch is a mesh, points are made on its surface, about four for each pixel of the maps.

        Parameters
        ----------
        frame : WallFrame
            The wall frame.
        gsd_m : float
            Side of a pixel of the maps, m.
        several : bool
            Whether the wall has several views (separately mapped parts). Points on a mesh are then drawn at random on all
            triangles, also on those that are steep in the wall frame.
        """
        if self.mesh is None:
            sample = self.points[:: max(len(self.points) // SAMPLE, 1)]
            return WallPoints(frame.to_wall(sample), lambda motion: self._in_wall_frame(frame, motion))
        if several:
            return WallPoints.of(frame.to_wall(_spread_over(self.mesh, gsd_m / 2)))
        from pipeline.change.difference import surface_raster

        mesh = self.mesh.with_vertices(frame.to_wall(self.mesh.vertices))
        grid = Grid.over(mesh.bounds, gsd_m / 2)
        heights = surface_raster(mesh, grid).heights
        row, column = np.nonzero(np.isfinite(heights))
        x, y = grid.x_min + (column + 0.5) * grid.gsd, grid.y_max - (row + 0.5) * grid.gsd
        return WallPoints.of(np.stack([x, y, heights[row, column]], axis=1).astype(np.float64))

    def _in_wall_frame(self, frame: WallFrame, motion: RigidTransform) -> Iterator[FloatArray]:
        """Yield all points in pieces (n, 3), wall frame, m, moved by `motion`; both rotations are applied at once."""
        turned = RigidTransform(motion.rotation @ frame.rotation, motion.translation)
        for piece in in_pieces(self.chunks(), POINTS_AT_ONCE):
            yield turned.apply_to_columns((piece - frame.origin).T).T


def in_pieces(chunks: Iterable[FloatArray], most: int) -> Iterator[FloatArray]:
    """Yield the points of chunks (n, 3) in pieces of at most `most` points."""
    return (chunk[start : start + most] for chunk in chunks for start in range(0, len(chunk), most))


def _spread_over(mesh: TriangleMesh, apart_m: float) -> FloatArray:
    """Return points (n, 3) at random on a mesh, one for each square of side `apart_m` on its surface, m."""
    corners = mesh.vertices[mesh.faces]
    sides = corners[:, 1:] - corners[:, :1]
    ends = np.cumsum(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2)
    random = KeyedRandom(0).child("monitor", "mesh").generator()
    face = np.searchsorted(ends, random.uniform(0, ends[-1], int(ends[-1] / apart_m**2)))
    share = random.uniform(size=(len(face), 2))
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    return np.asarray(corners[face, 0] + np.einsum("nk,nki->ni", share, sides[face]))


def with_reference(reference: Path, paths: Sequence[Path]) -> list[Path]:
    """Return the paths of the epochs with the reference first; it is listed once, also where it is one of them."""
    return [reference, *(path for path in paths if path.resolve() != reference.resolve())]


def find_epochs(paths: Sequence[Path], times: Sequence[str] = ()) -> list[EpochSource]:
    """Find the epochs that the user's paths name, in order, with their times.

    Parameters
    ----------
    paths : sequence of Path
        A file is an epoch, a folder of scans is one, and a run of `simulate` is all of its epochs.
    times : sequence of str
        Time of each epoch, ISO 8601; empty: as the files state.

    Raises
    ------
    InputError
        For paths that hold no epoch, the same file twice, fewer than two epochs, and times that run backwards.
    """
    found = [source for path in paths for source in _sources(path)]
    if len(found) < 2:
        raise InputError(
            f"only {len(found)} epoch is given",
            where="EPOCH",
            allowed="two epochs or more",
            remedy="give at least two epochs, the reference first",
        )
    if times and len(times) != len(found):
        raise InputError(
            f"{len(times)} times are given for {len(found)} epochs", where="--times", remedy="give one time for each epoch"
        )
    seen: dict[Path, str] = {}
    for source in found:
        for file in source.files:
            if (real := file.resolve()) in seen:
                raise InputError("the epoch is given twice", where=str(file), remedy="name each epoch once")
            seen[real] = source.name
    _check_contents(found)
    timed = [
        EpochSource(source.path, source.files, _time_of(source, given), source.run)
        for source, given in zip(found, times or itertools.repeat(None, len(found)), strict=True)
    ]
    check_order([source.time for source in timed], [source.name for source in timed])
    return timed


def _time_of(source: EpochSource, given: str | None) -> EpochTime:
    """When an epoch was measured; that of a run is stated by its points."""
    return time_of(source.files[0], given) if source.run is not None else time_of(source.path, given, source.files)


def _check_contents(sources: Sequence[EpochSource]) -> None:
    """Raise InputError if two epochs of one file each are copies of each other."""
    by_size: dict[int, list[Path]] = {}
    for source in sources:
        if len(source.files) == 1:
            by_size.setdefault(source.files[0].stat().st_size, []).append(source.files[0])
    for files in by_size.values():
        seen: dict[str, Path] = {}
        for file in files if len(files) > 1 else ():
            first = seen.setdefault(sha256(file), file)
            if first is not file:
                raise InputError(f"the epoch is a copy of {first}", where=str(file), remedy="name each epoch once")


def read_epoch(source: EpochSource, options: MonitorOptions) -> EpochData:
    """Read the points of an epoch from its files, in metres.

    source: the files. options: they give the unit and the columns of text files. Raises InputError if a file cannot be used.
    """
    if source.run is not None:
        return _of_run(source, source.run)
    if all(file.suffix.lower() in _LAS for file in source.files) and sum(map(count_points, source.files)) > WHOLE_POINTS:
        return _sampled(source.files, options.unit)
    parts = [_read_file(file, options) for file in source.files]
    if len(parts) == 1:
        return parts[0]
    if any(part.mesh is not None for part in parts):
        raise InputError(
            "the folder contains a mesh or an elevation model beside scans, which cannot be joined",
            where=str(source.path),
            allowed="scans only, or one mesh",
            remedy="move the mesh or the elevation model to a folder of its own",
        )
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    positions = [part.position for part in parts if part.position is not None]
    position = np.mean(positions, axis=0) if positions else None
    return EpochData(np.concatenate([part.points for part in parts]), None, position, parts[0].crs, notes)


def read_laser_scans(source: EpochSource, options: MonitorOptions) -> list[RawScan]:
    """Read the laser scans of an epoch with intensity, times and the scanner's place, survey coordinates, m.

    source: files of the epoch. options: they give the unit and the columns of text files. Raises InputError if a file cannot be
    used, or holds a mesh or an elevation model instead of points.
    """
    if source.is_surface:
        raise InputError(
            "the file is a mesh or an elevation model, but the points of a laser scanner are needed",
            where=source.name,
            remedy="run scarpsim monitor on the scans that the mesh or model was made from",
        )
    if source.run is None:
        return [scan for file in source.files for scan in read_scans(file, options.unit, options.columns)]
    frame = _frame_of_run(source.run)
    scans = read_scans(source.files[0])
    return [replace(scan, cloud=replace(scan.cloud, points=frame.to_world(scan.cloud.points))) for scan in scans]


def _sampled(files: tuple[Path, ...], unit: str | None) -> EpochData:
    """Read large files once, to get a sample of their points and their number, extent and coordinate system."""
    stated = sum(map(count_points, files))
    step, count = -(-stated // _SAMPLE), 0
    sample, kept, boxes, first = [], [], [], None
    for chunk in itertools.chain.from_iterable(read_chunks(file, unit) for file in files):
        if not len(chunk):
            continue
        first = chunk[:_SAMPLE].copy() if first is None else first
        sample.append(chunk[-count % step :: step].copy())
        if stated <= _KEPT_POINTS:
            kept.append(np.rint((chunk - first[0]) / _STEP_M).astype(np.int32))
        boxes.append(bounding_box(chunk))
        count += len(chunk)
    if first is None:
        raise InputError(
            "the file contains no points but those flagged as withheld, synthetic or noise",
            where=str(files[0]),
            remedy="export the file again, with its points, or clear these flags",
        )
    bounds = bounding_box(np.concatenate(boxes))
    large = LargeFiles(files, unit, count, first, bounds, tuple(kept))
    note = f"its {count:,} points were read in chunks: memory depends on the maps alone"
    return EpochData(np.concatenate(sample), None, None, _crs_of(files[0]), (note,), large)


def epoch_files(folder: Path) -> list[Path]:
    """Return the files of a folder that, by their suffix, contain scans, clouds, meshes or elevation models, sorted by name."""
    found = (each for each in folder.iterdir() if each.suffix.lower() in _ANY and not each.name.endswith(SIDECAR))
    return sorted(each for each in found if each.is_file())


def _sources(path: Path) -> list[EpochSource]:
    unknown = EpochTime(None, "")
    if not path.exists():
        raise InputError("there is no such file or folder", where=str(path), remedy="give the path of an existing file or folder")
    if path.is_file():
        return [EpochSource(path, (path,), unknown)]
    if (path / RUN_FILE).is_file():
        return _epochs_of_run(path, "epoch_*")
    if (path.absolute().parent / RUN_FILE).is_file():
        return _epochs_of_run(path.absolute().parent, path.absolute().name)
    files = tuple(epoch_files(path))
    if not files:
        raise InputError(
            "the folder contains no scan",
            where=str(path),
            allowed=f"files of scans ({', '.join(_ANY)}), or a run of simulate",
            remedy="copy the scans into this folder, or name another one",
        )
    return [EpochSource(path, files, unknown)]


def _epochs_of_run(folder: Path, pattern: str) -> list[EpochSource]:
    """Return the epochs of a run of `simulate` whose folders match a pattern of `glob`."""
    record = read_run(folder / RUN_FILE, "make the run again with scarpsim simulate")
    if not record.get("wall_frame"):
        raise InputError(
            "the run does not state its wall frame",
            where=str(folder / RUN_FILE),
            remedy="make the run again with scarpsim simulate",
        )
    epochs = sorted(each for each in folder.glob(pattern) if (each / "points.laz").is_file())
    if not epochs:
        raise InputError(
            "this is a run without a finished epoch",
            where=str(folder / pattern),
            remedy="finish the run with scarpsim simulate --resume",
        )
    return [EpochSource(each, (each / "points.laz",), EpochTime(None, ""), record) for each in epochs]


def _of_run(source: EpochSource, run: dict[str, Any]) -> EpochData:
    """An epoch of a run, whose points are in the wall frame of its config."""
    frame = _frame_of_run(run)
    (scan,) = read_scans(source.files[0], only_points=True)
    middle = scan.cloud.points.mean(axis=0) + np.array([0.0, 0.0, _BEFORE_M])
    notes = ("an epoch of a run of simulate: its points were put into survey coordinates",)
    return EpochData(frame.to_world(scan.cloud.points), None, frame.to_world(middle), "", notes)


def _frame_of_run(run: dict[str, Any]) -> WallFrame:
    """Return the wall frame of a run of `simulate`, in which its points are."""
    stated = run["wall_frame"]
    return WallFrame(np.array(stated["rotation"]), np.array(stated["origin_m"]))


def _read_file(path: Path, options: MonitorOptions) -> EpochData:
    suffix = path.suffix.lower()
    if suffix in DEMS:
        found = reference_from_dem(path, options.unit)
        above = found.mesh.vertices.mean(axis=0) + np.array([0.0, 0.0, _BEFORE_M])
        return EpochData(found.mesh.vertices, found.mesh, above, _crs_of_epsg(found.epsg), found.words)
    if not is_cloud(path):
        mesh, notes = read_mesh(path, options.unit or "m")
        return EpochData(mesh.vertices, mesh, _before(mesh), "", notes)
    scans = read_scans(path, options.unit, options.columns, only_points=True)
    positions = [scan.position for scan in scans if scan.position is not None]
    notes = tuple(dict.fromkeys(note for scan in scans for note in scan.cloud.notes))
    position = np.mean(positions, axis=0) if positions else None
    points = scans[0].cloud.points if len(scans) == 1 else np.concatenate([scan.cloud.points for scan in scans])
    return EpochData(points, None, position, _crs_of(path), notes)


def _before(mesh: TriangleMesh) -> FloatArray:
    """Return a place in front of a mesh (3,), m, on the side to which its triangles face."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    return np.asarray(mesh.vertices.mean(axis=0) + _BEFORE_M * normal / max(float(np.linalg.norm(normal)), 1e-12))


def _crs_of(path: Path) -> str:
    """Return the WKT of a LAS file's coordinate system; empty if it states none that can be read."""
    if path.suffix.lower() not in _LAS:
        return ""
    import laspy

    try:
        with laspy.open(path) as reader:
            crs = reader.header.parse_crs()
    except Exception:  # an unreadable record of the coordinate system is none
        return ""
    return "" if crs is None else _in_metres(crs)


def _crs_of_epsg(code: int | None) -> str:
    """Return the WKT of a coordinate system; empty without a code, or for one that is not known."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return "" if code is None else _in_metres(CRS.from_epsg(code))
    except CRSError:
        return ""


def _in_metres(crs: Any) -> str:
    """Return the WKT of a coordinate system whose coordinates were converted to metres."""
    import warnings

    from pyproj import CRS

    if all(axis.unit_conversion_factor == 1.0 for axis in crs.axis_info[:2]):
        return str(crs.to_wkt())
    with warnings.catch_warnings():  # of parameters that a PROJ string does not hold
        warnings.simplefilter("ignore")
        parts = {key: value for key, value in crs.to_dict().items() if key not in ("to_meter", "vunits", "vto_meter")}
        metric = CRS.from_dict({**parts, "units": "m"}).to_json_dict()
    return str(CRS.from_json_dict({**metric, "name": f"{crs.name}, converted to metres"}).to_wkt())

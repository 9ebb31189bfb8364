"""Collect an epoch's points as a file holds them: the points of the sensor's grid and further returns, of all stations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.formats.point_cloud import PointCloud
from scene.geometry.frame import WallFrame
from sensors.signal_chain.observation import Observation

if TYPE_CHECKING:
    from pipeline.formats.points.e57 import E57Scan


def recorded_points(observations: Sequence[Observation]) -> PointCloud:
    """Collect all points that the sensor recorded in an epoch as one point cloud, m, as points.laz stores it.

    observations: one for each station (set-up of the scanner). The points are in the order of the stations, of the
    pulses, and of the returns of a pulse. Times count from the start of the station's scan.

    Extra channels are the true values (such as `true_range_m`, if asked for); `block`, the label of the fallen block;
    `return_number` and `number_of_returns` if a pulse has several returns; `scan_angle_rad` of a scanner (nominal, from
    straight down); and `station`, from 1, if there are several.
    """
    clouds = [_of_station(observation) for observation in observations]
    if len(clouds) == 1:
        return clouds[0]
    if any("return_number" in cloud.extra for cloud in clouds):
        clouds = [_with_returns(cloud) for cloud in clouds]
    station = np.repeat(np.arange(1, len(clouds) + 1, dtype=np.uint8), [len(cloud.points) for cloud in clouds])
    columns = {name: np.concatenate([cloud.extra[name] for cloud in clouds]) for name in clouds[0].extra}
    return PointCloud(
        points=np.concatenate([cloud.points for cloud in clouds]),
        intensity=_joined([cloud.intensity for cloud in clouds]),
        gps_time=_joined([cloud.gps_time for cloud in clouds]),
        extra={**columns, "station": station},
    )


def at_time(cloud: PointCloud, start_s: float) -> PointCloud:
    """Return a cloud with absolute times: the start of the scan, `start_s`, plus the time of each point since then, s.

    A cloud without times, of a sensor that records everything at once, gets `start_s` for all points.
    """
    time = np.zeros(len(cloud.points)) if cloud.gps_time is None else cloud.gps_time
    return replace(cloud, gps_time=start_s + time)


def scans_of(observations: Sequence[Observation], frame: WallFrame | None = None) -> list[E57Scan]:
    """Convert each observation of an epoch to a scan for an E57 file, with the channels `row` and `column` of the sensor's grid.

    observations: one for each station (set-up). frame: the wall frame, for poses (position and rotation) in world coordinates;
    None: poses in the wall frame.
    """
    from pipeline.formats.points.e57 import E57Scan  # its library takes a tenth of a second to load

    frame = frame or WallFrame.identity()
    scans = []
    for number, seen in enumerate(observations, start=1):
        cloud = _grid_points(seen)
        row, column = (axis.astype(np.int32) for axis in np.nonzero(seen.valid))
        local = PointCloud(cloud.points - seen.viewpoint, cloud.intensity, cloud.gps_time, {"row": row, "column": column})
        scans.append(E57Scan(f"station {number}", local, frame.to_world(seen.viewpoint), frame.rotation.T))
    return scans


def _grid_points(seen: Observation) -> PointCloud:
    """Return the points in the grid, one for each cell with a return."""
    return _of_station(replace(seen, further=None))


def _of_station(seen: Observation) -> PointCloud:
    """Collect the points of one station."""
    valid, further = seen.valid, seen.further
    channels = {**seen.truth, "block": seen.block}
    if seen.zenith_rad is not None:
        channels["scan_angle_rad"] = np.broadcast_to(np.pi - seen.zenith_rad, valid.shape)
    optional = {"intensity": seen.intensity, "gps_time": seen.gps_time}
    values: dict[str, Any] = {name: None if channel is None else channel[valid] for name, channel in optional.items()}
    extra: dict[str, Any] = {name: channel[valid] for name, channel in channels.items()}
    if further is None:
        return PointCloud(seen.points[valid], **values, extra=extra)
    cell = np.concatenate([np.flatnonzero(valid), further.cell])
    number = np.concatenate([further.grid_number[valid], further.number])
    order = np.lexsort((number, cell))
    beside = {**further.truth, "block": further.block}
    if "scan_angle_rad" in channels:
        beside["scan_angle_rad"] = channels["scan_angle_rad"].ravel()[further.cell]
    time = seen.gps_time
    return PointCloud(
        points=np.concatenate([seen.points[valid], further.points])[order],
        intensity=np.concatenate([values["intensity"], further.intensity])[order],
        gps_time=None if time is None else time.ravel()[cell][order],
        extra={name: np.concatenate([channel, beside[name]])[order] for name, channel in extra.items()}
        | {"return_number": number[order], "number_of_returns": further.grid_count.ravel()[cell][order]},
    )


def _with_returns(cloud: PointCloud) -> PointCloud:
    """Return the cloud with return numbers: 1 of 1 if it has none."""
    ones = np.ones(len(cloud.points), dtype=np.uint8)
    extra = {"return_number": ones, "number_of_returns": ones} | cloud.extra
    return PointCloud(cloud.points, cloud.intensity, cloud.gps_time, extra)


def _joined(channels: Sequence[Any]) -> Any:
    """Concatenate a channel of several clouds; None if one of them lacks it."""
    return None if any(channel is None for channel in channels) else np.concatenate(channels)

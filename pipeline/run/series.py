"""Make the epochs of a series: the wall and the conditions of the sensor at each time, and the truth (series.json)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.config.series import SeriesConfig
from pipeline.config.simulation import SimulationConfig
from pipeline.report.progress import Progress
from pipeline.run.epoch import EpochScene, LaterEpoch, ReferenceEpoch, SinceLast, observe_scene, to_world
from pipeline.run.site import SensorSite
from scene.blocks.carve import Carved, block_records
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, FloatArray, IntArray, TriangleMesh
from scene.meshes.winding import orient_to_sensors
from scene.ray_casting.raycast import RayCaster
from scene.series.cover import Cover
from scene.series.deposits import Ground
from scene.series.events import drawn_rockfalls, given_rockfalls, numbered
from scene.series.evolution import KINDS, Loose, Rules, WallState, advanced
from scene.series.placement import join_blocks, no_blocks
from scene.walls.imported import ImportedWall
from scene.walls.safe_zone import safe_zone
from sensors.cameras.camera import axis_rotation
from sensors.laser.tls import LaserScanner
from sensors.models.conditions import PoseShift, effect_values, pose_shifts, with_effects, with_stereo_effects
from sensors.stereo.stereo_matched import MatchedStereoPair
from sensors.stereo.stereo_pair import StereoPair

SERIES_FILE = "series.json"


@dataclass(frozen=True)
class SeriesConditions:
    """Conditions of measurement that change from epoch to epoch of a simulated time series.

    Attributes
    ----------
    poses : list of PoseShift
        Real minus surveyed pose (position and rotation) of the sensor, for each of n epochs.
    effects : dict of dicts of (n,) arrays
        Increase of the parameters of the sensor's systematic effects over the configured values, by effect and parameter.
    covers : list of Cover
        Snow and vegetation on the wall, for each epoch.
    """

    poses: list[PoseShift]
    effects: dict[str, dict[str, FloatArray]]
    covers: list[Cover]

    @classmethod
    def of(cls, series: SeriesConfig, random: KeyedRandom) -> SeriesConditions:
        """Draw the conditions of all epochs of a time series: pose and effects of the sensor, snow and vegetation.

        series: section `series` of the config. random: the run's source of random numbers.
        """
        keyed, hours, given = random.child("series", "conditions"), series.hours, series.conditions
        snow, vegetation = (
            np.zeros(len(hours)) if course is None else course.values(hours, keyed.child(name))
            for name, course in (("snow_m", given.snow_m), ("vegetation_m", given.vegetation_m))
        )
        covers = [Cover(float(thick), float(high)) for thick, high in zip(snow, vegetation, strict=True)]
        poses = pose_shifts(given.pose, hours, keyed.child("pose"))
        return cls(poses, effect_values(given.effects, hours, keyed.child("effects")), covers)

    def to_dict(self) -> dict[str, Any]:
        """Return the conditions at each epoch for series.json, as lists by name; conditions that are always zero are left out."""
        found = {f"{name}.{key}": values.tolist() for name, each in self.effects.items() for key, values in each.items()}
        for name in ("position_m", "rotation_rad"):
            values = np.array([getattr(pose, name) for pose in self.poses])
            found |= {f"pose.{name}": values.tolist()} if values.any() else {}
        for name in ("snow_m", "vegetation_m"):
            heights = [getattr(cover, name) for cover in self.covers]
            found |= {name: heights} if any(heights) else {}
        return found


@dataclass(frozen=True)
class Series:
    """A time series of epochs to be simulated: it yields the true wall and the state of the sensor at each epoch.

    Attributes
    ----------
    config : SimulationConfig
        Config of the run.
    series : SeriesConfig
        Its section `series`.
    site : SensorSite
        The untouched wall, and the sensor as configured.
    random : KeyedRandom
        The run's source of random numbers.
    conditions : SeriesConditions
        Pose and effects of the sensor, snow and vegetation at each epoch.
    plants : KeyedRandom, optional
        Source of random numbers for the places where plants grow. Several series with the same one have the same plants.
        None: `random`.
    """

    config: SimulationConfig
    series: SeriesConfig
    site: SensorSite
    random: KeyedRandom
    conditions: SeriesConditions
    plants: KeyedRandom | None = None

    @classmethod
    def of(cls, config: SimulationConfig, series: SeriesConfig, site: SensorSite, random: KeyedRandom) -> Series:
        """Prepare the time series of a run: draw the pose and effects of the sensor, snow and vegetation of all epochs.

        Parameters
        ----------
        config : SimulationConfig
            Config of the run.
        series : SeriesConfig
            Its section `series`.
        site : SensorSite
            The untouched wall, and the sensor as configured.
        random : KeyedRandom
            The run's source of random numbers.
        """
        return cls(config, series, site, random, SeriesConditions.of(series, random))

    @property
    def up(self) -> FloatArray:
        """(3,) unit vector against gravity, wall frame."""
        return self.site.frame.direction_to_wall(np.array([0.0, 0.0, 1.0]))

    def site_at(self, number: int) -> SensorSite:
        """Return the wall and the sensor in the conditions of an epoch, to simulate its measurement.

        The wall is the untouched one, with snow and plants. The sensor has the pose, and the parameters of systematic
        effects, of that time. number: of the epoch; 0 is the reference.
        """
        shift = self.conditions.poses[number]
        values = {
            name: {key: float(course[number]) for key, course in each.items()} for name, each in self.conditions.effects.items()
        }
        rotation = self.site.frame.rotation

        def scanner(sensor: LaserScanner) -> LaserScanner:
            changed = replace(sensor, model=with_effects(sensor.model, values))
            if shift.is_null:
                return changed
            x, y, z = (axis_rotation(axis, float(angle)) for axis, angle in enumerate(shift.rotation_rad))
            return replace(changed, shift_m=rotation @ shift.position_m, turn=rotation @ (z @ y @ x) @ rotation.T)

        def pair(sensor: StereoPair) -> StereoPair:
            return replace(sensor, model=with_stereo_effects(sensor.model, values, shift))

        sensor = self.site.sensor
        mesh = self.covered(self.site.mesh, number)
        if isinstance(sensor, LaserScanner):
            further = tuple(scanner(each) for each in self.site.further_stations)
            return replace(self.site, mesh=mesh, sensor=scanner(sensor), further_stations=further)
        if isinstance(sensor, MatchedStereoPair):
            return replace(self.site, mesh=mesh, sensor=replace(sensor, pair=pair(sensor.pair)))
        return replace(self.site, mesh=mesh, sensor=pair(sensor))

    def covered(self, mesh: TriangleMesh, number: int) -> TriangleMesh:
        """Return a wall with the snow and vegetation of an epoch added to its surface.

        mesh: the bare wall, wall frame. number: of the epoch; 0 is the reference.
        """
        random = self.random if self.plants is None else self.plants
        return self.conditions.covers[number].on(mesh, self.up, random.child("series", "cover"))

    def rules(self) -> Rules:
        """Draw all rockfalls of the time series, to follow the wall through time by `states`.

        Returns the rockfalls with what holds at all epochs: where blocks may lie, their shapes, and the ground on which
        fragments come to rest. Raises InputError if the wall has no room for blocks, or if there would be too many rockfalls.
        """
        keyed, given = self.random.child("series", "rockfalls"), self.series
        rockfalls = given_rockfalls(given.events, given.falls_h())
        if given.rockfall is not None:
            rockfalls += drawn_rockfalls(given.rockfall, given.precursor, float(given.hours[-1]), keyed)
        zone = safe_zone(RayCaster(self.site.mesh), self.config.rockfall.safe_zone_offset_m)
        ground = Ground.below(self.site.mesh, self.up)
        return Rules(zone, self.config.rockfall, given.deposits, ground, numbered(rockfalls), keyed)

    def states(self, rules: Rules) -> Iterator[WallState]:
        """Follow the wall through time: yield its state at each epoch after the first, with the rocks that have moved or fallen.

        rules: the rockfalls of the series. With `cumulative: false`, each state has only what fell since the epoch before.
        """
        hours, untouched = self.series.hours, self.site.mesh
        state = WallState(0.0, untouched)
        for before, now in zip(hours[:-1].tolist(), hours[1:].tolist(), strict=True):
            state = advanced(state if self.series.cumulative else WallState(before, untouched), now, rules)
            yield state

    def scenes(self) -> Iterator[SeriesScene]:
        """Yield the true wall of each epoch after the first, in order, for the sensor to observe.

        The rockfalls are drawn or given by the config; with `surfaces`, each wall is a mesh of the user. Raises InputError if a
        rockfall finds no room or a mesh cannot be used.
        """
        if self.series.surfaces:
            for number in range(1, self.series.count):
                yield self._surface(number)
            return
        rules, before = self.rules(), WallState(0.0, self.site.mesh)
        for number, state in enumerate(self.states(rules), start=1):
            yield SeriesScene(number, self._scene(state, rules, number), state, rules, _new_labels(state, before, rules))
            before = state

    def _scene(self, state: WallState, rules: Rules, number: int) -> EpochScene:
        """Return the wall, with its snow and vegetation, as a sensor sees it at an epoch."""
        fallen = state.fallen
        solids = join_blocks([each.block for each in fallen]) if fallen else no_blocks()
        volumes = np.array([each.volume_m3 for each in fallen])
        records = [
            {**record, "label": each.rockfall.number} for record, each in zip(block_records(solids, volumes), fallen, strict=True)
        ]
        mesh = self.covered(state.mesh(rules), number)
        carved = Carved(mesh, volumes, state.wall_volume_m3, state.balance_m3)
        return EpochScene(carved, solids, records, len(rules.rockfalls))

    def _surface(self, number: int) -> SeriesScene:
        """Read the mesh that the user gave for an epoch (`surfaces`), wall frame."""
        path = self.series.surfaces[number]
        wall = self.config.wall
        if not isinstance(wall, ImportedWall):
            raise InputError(
                "meshes of the single epochs need a wall that is imported from a mesh",
                where="series.surfaces",
                remedy="leave `wall` out: the first of these meshes is then the wall",
            )
        mesh, _ = wall.model_copy(update={"mesh": path}).load()
        mesh = mesh.with_vertices(self.site.frame.to_wall(mesh.vertices))
        mesh, _ = orient_to_sensors(mesh, list(self.site.viewpoints.values()), str(path), cleaned=True)
        carved = Carved(self.covered(mesh, number), np.empty(0), 0.0, 0.0)
        return SeriesScene(number, EpochScene(carved, no_blocks(), [], 0), None, None, np.empty(0, dtype=np.int32))


@dataclass(frozen=True)
class SeriesScene:
    """The true wall at one epoch of a simulated time series.

    Attributes
    ----------
    number : int
        Number of the epoch, from 1.
    scene : EpochScene
        The wall as the sensor observes it, with the records of the fallen blocks.
    state : WallState, optional
        The wall without snow and plants, with the rocks that have moved or fallen. None if the user's own meshes
        (`surfaces`) are the wall.
    rules : Rules, optional
        All rockfalls of the series and the placement of their blocks. None with the user's own meshes.
    new : (k,) int32 array
        Labels of what has fallen, moved or come to rest since the epoch before.
    """

    number: int
    scene: EpochScene
    state: WallState | None
    rules: Rules | None
    new: IntArray


def observe_series_epoch(
    series: Series,
    reference: ReferenceEpoch,
    scene: SeriesScene,
    before: NDArray[np.float32] | None,
    progress: Progress,
) -> LaterEpoch:
    """Simulate the measurement of one epoch of a time series, and compare it with the first and with the previous epoch.

    Parameters
    ----------
    series : Series
        The time series.
    reference : ReferenceEpoch
        Its first epoch.
    scene : SeriesScene
        The true wall of this epoch.
    before : (h, w) array, optional
        Heights of the previous epoch after registration, m; None: it is not compared.
    progress : Progress
        Receives the progress.
    """
    site, number = series.site_at(scene.number), scene.number
    found = observe_scene(series.config, site, reference, number, scene.scene, series.random, progress)
    since = None
    if before is not None:
        block = np.where(np.isin(found.raster.block, scene.new), found.raster.block, WALL).astype(np.int32)
        since = SinceLast(before - found.raster.heights, block)
    return replace(found, since_last=since, rockfalls=0 if scene.rules is None else len(scene.rules.rockfalls))


def _new_labels(state: WallState, before: WallState, rules: Rules) -> IntArray:
    """Return the block labels of what fell, moved or came to rest between two epochs."""
    labels = []
    for each in state.loose:
        now, then = (each.rockfall.displacement_m(one.time_h) for one in (state, before))
        number = each.rockfall.number
        if now is None and then is not None:
            labels += [rules.label(number, kind) for kind in ("missing", "deposit")]
        elif now != then:
            labels.append(rules.label(number, "moved"))
    return np.array(labels, dtype=np.int32)


@dataclass
class SeriesTruth:
    """The true rockfalls and motions of a simulated time series, collected epoch by epoch for the file series.json.

    All attributes except `series` are None until the first epoch is added.

    Attributes
    ----------
    series : Series
        The time series that is simulated.
    rules : Rules
        All rockfalls, and how their blocks are shaped and placed.
    rocks : dict
        By number of the rockfall, a pair: the rock cut out of the wall, and the bounding box of its fragments at the foot
        of the wall (wall frame, m), or None if there are no fragments.
    volumes : list of dict
        For each epoch its number and, in m3, the volumes that have fallen and that have begun to move, the volume of the
        first wall, and the balance of volumes (0 except for rounding).
    """

    series: Series
    rules: Rules | None = None
    rocks: dict[int, tuple[Loose, FloatArray | None]] | None = None
    volumes: list[dict[str, float]] | None = None

    def add(self, scene: SeriesScene) -> None:
        """Add the true wall of an epoch of the series; one whose mesh the user gives has no rockfalls and is skipped."""
        if scene.state is None:
            return
        self.rules = scene.rules
        laid = {each.number: each.mesh.bounds for each in scene.state.deposits}
        self.rocks = {
            **(self.rocks or {}),
            **{each.rockfall.number: (each, laid.get(each.rockfall.number)) for each in scene.state.loose},
        }
        state = scene.state
        epoch = {
            "epoch": scene.number,
            "fallen_m3": sum(each.volume_m3 for each in state.fallen),
            "moving_m3": sum(each.volume_m3 for each in state.hanging),
            "wall_m3": state.wall_volume_m3,
            "balance_m3": state.balance_m3,
        }
        self.volumes = [*(self.volumes or []), epoch]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of series.json: times, rockfalls, volumes and conditions of the epochs added so far."""
        series, rules = self.series.series, self.rules
        held = self.rocks or {}
        return {
            "schema": 1,
            "times": [_iso(series, number) for number in range(series.count)],
            "hours": series.hours.tolist(),
            "cumulative": series.cumulative,
            "kinds": list(KINDS),
            "events": [] if rules is None else [self._event(held[number], rules) for number in sorted(held)],
            "volumes": self.volumes or [],
            "conditions": self.series.conditions.to_dict(),
            "surfaces": [str(path) for path in series.surfaces],
        }

    def _event(self, held: tuple[Loose, FloatArray | None], rules: Rules) -> dict[str, Any]:
        """Return the record of a rockfall."""
        rock, deposit = held
        rockfall, hours = rock.rockfall, self.series.series.hours
        (block,) = block_records(rock.block, np.array([rock.volume_m3]))
        after = np.flatnonzero(hours >= rockfall.falls_h)
        return {
            "event": rockfall.number,
            "labels": {kind: rules.label(rockfall.number, kind) for kind in KINDS},
            "falls": _iso_after(self.series.series, rockfall.falls_h),
            "falls_h": rockfall.falls_h,
            "first_missing_epoch": int(after[0]) if len(after) else None,
            "volume_m3": rock.volume_m3,
            "block": {
                **{name: block[name] for name in ("shape", "size_m", "bbox_m", "position_m")},
                "world_position_m": to_world(self.series.site, block["position_m"]),
            },
            "precursor": None
            if rockfall.motion is None
            else rockfall.motion.model_dump(include={"law", "lead_h", "displacement_m"}),
            "displacement_m": [rockfall.displacement_m(float(hour)) for hour in hours],
            "deposit_bbox_m": None if deposit is None else deposit.ravel().tolist(),
        }


def _iso(series: SeriesConfig, number: int) -> str:
    """Return the time of an epoch in ISO 8601."""
    return _iso_after(series, float(series.hours[number]))


def _iso_after(series: SeriesConfig, hours: float) -> str:
    """Return a time some hours after the first epoch in ISO 8601."""
    return (series.when(0) + timedelta(hours=hours)).isoformat().replace("+00:00", "Z")

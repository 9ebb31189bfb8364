"""Predict what a series of epochs will show: the smallest rockfall, and how early a moving block is noticed.

Trial epochs of the config's wall are simulated with its sensor and the conditions of its series, and compared with the reference
as `monitor` does. In some, blocks of many sizes are missing; in others, they have moved out by different amounts. Logistic
regression gives the probability that `monitor` lists such a change,

    logit P = a + b ln V  (missing),    logit P = a + b ln V + c ln u  (moved by u),

of which the promised values are the 95 % points. Only blocks count of which the sensor sees at least half. Intervals come from a
bootstrap over blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.difference import cast_raster
from pipeline.config.series import RegularTimes, SeriesConfig
from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.monitoring.comparison import ReferenceHeights, compare_epoch
from pipeline.monitoring.frame import raster_of
from pipeline.monitoring.gridding import WallPoints
from pipeline.report.progress import Progress
from pipeline.run.acquisition import acquire
from pipeline.run.recorded_points import recorded_points
from pipeline.run.series import Series
from pipeline.run.site import SensorSite, prepare_site
from scene.blocks.block import Blocks, place_blocks
from scene.blocks.carve import carve, removed_rocks
from scene.blocks.distributions import Lognormal
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, FloatArray, IntArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.series.config import Motion
from scene.series.evolution import joined_meshes

AVERAGED = (1, 4)
"""Numbers of scans that make up an epoch."""
SCHEDULES_H = (1.0, 24.0, 168.0)
"""Intervals that are promised beside the config's own: hour, day, week."""
PROBABILITY = 0.95
_ENOUGH, _MOST_TRIALS, _FEWEST = 120, 6, 10
"""Blocks after which no further trial epoch is made, most trial epochs of each kind, and fewest blocks for a regression."""
_SIDE_PX, _SIDE_SIGMA = 4.0, 0.5
"""Median side of the missing blocks, pixels, and the standard deviation of its natural logarithm."""
_APART_PX = 6.0
_MOST_BLOCKS, _FILLED = 120, 0.12
"""Most blocks of a trial, and the largest share of the wall under them."""
_MOVED_LEVELS = (0.1, 3.0)
"""Displacements of the moved blocks, in median levels of detection."""
_SEEN = 0.5
"""Share of a block that the sensor must see for it to count."""
_GOLDEN = 0.6180339887
"""Step, over the series, from the conditions of one trial epoch to those of the next."""
_BOOTSTRAPS = 200
_PRIOR = 0.02
"""Precision of the prior of the slopes, for predictors of unit standard deviation."""
_CURVE_POINTS = 60


@dataclass(frozen=True)
class DetectionLaw:
    """Give the probability P that `monitor` lists a change of volume V, by a logistic regression on simulated trial blocks.

    For a block that has moved by u, ln(P / (1 - P)) = a + b ln V + c ln u. Rock that has fallen has no term in u.

    Attributes
    ----------
    coefficients : (2,) or (3,) array
        Best fit of a, b and, for moved blocks, c; V is in m3 and u in m.
    resampled : (n, 2) or (n, 3) array
        Coefficients fitted to n bootstrap samples of the trial blocks, for confidence intervals.
    blocks : int
        Number of trial blocks that were used: those of which the sensor sees at least half.
    seen_share : float
        `blocks` divided by the number of all trial blocks.
    """

    coefficients: FloatArray
    resampled: FloatArray
    blocks: int
    seen_share: float

    def probability(self, volume_m3: FloatArray, moved_m: FloatArray | float = 1.0) -> FloatArray:
        """Return the probability that changes are listed.

        Parameters
        ----------
        volume_m3 : (k,) array
            Volumes of the blocks, m3.
        moved_m : (k,) array or float
            How far each block has moved, m; ignored by a law for rock that has fallen.

        Returns
        -------
        (k,) array
            Probabilities, 0 to 1.
        """
        return _logistic(_design(np.asarray(volume_m3), np.asarray(moved_m), len(self.coefficients)) @ self.coefficients)

    def volume_m3(self, probability: float = PROBABILITY) -> tuple[float, float, float]:
        """Return the volume of fallen rock, m3, that is listed with a given probability, by default 0.95.

        The three numbers are the volume and the lower and upper end of its 95 % confidence interval.
        """
        logit = np.log(probability / (1 - probability))
        return _with_interval(self, lambda fit: np.exp((logit - fit[..., 0]) / fit[..., 1]))

    def displacement_m(self, volume_m3: float, probability: float = PROBABILITY) -> tuple[float, float, float]:
        """Return how far a block must have moved, m, to be listed with a given probability.

        Parameters
        ----------
        volume_m3 : float
            Volume of the block, m3.
        probability : float
            Probability of being listed, between 0 and 1.

        Returns
        -------
        (float, float, float)
            The displacement, and the lower and upper end of its 95 % confidence interval.
        """
        logit = np.log(probability / (1 - probability))
        return _with_interval(self, lambda fit: np.exp((logit - fit[..., 0] - fit[..., 1] * np.log(volume_m3)) / fit[..., 2]))


@dataclass(frozen=True)
class EpochPromise:
    """State which changes an epoch is predicted to show if it consists of a given number of scans, whose points are joined.

    Attributes
    ----------
    scans : int
        Number of scans in the epoch.
    level_m : float
        Median level of detection of the epoch's map of changes, m.
    missing : DetectionLaw
        Probability that fallen rock is listed, by its volume.
    moved : DetectionLaw
        Probability that a block that has moved is listed, by its volume and displacement.
    """

    scans: int
    level_m: float
    missing: DetectionLaw
    moved: DetectionLaw


@dataclass(frozen=True)
class SeriesPlan:
    """Store which rockfalls a series of epochs is predicted to show, and how early it shows a moving block.

    Attributes
    ----------
    sensor : str
        "stereo" or "tls".
    gsd_m : float
        Side of a pixel of the maps of changes, m.
    every_h : float or None
        Interval between the epochs of the config's series, h; None if it is not regular.
    promises : tuple of EpochPromise
        What an epoch shows, for each number of scans of which it may consist.
    volumes_m3 : tuple of float
        Volumes, m3, of the moving blocks for which warning times are predicted.
    motion : Motion
        How these blocks move out of the wall before they fall.
    """

    sensor: SensorName
    gsd_m: float
    every_h: float | None
    promises: tuple[EpochPromise, ...]
    volumes_m3: tuple[float, ...]
    motion: Motion

    @property
    def schedules_h(self) -> list[float]:
        """Intervals between epochs, h, for which warning times are predicted: an hour, a day, a week and the config's own."""
        own = () if self.every_h is None else (self.every_h,)
        return sorted({*SCHEDULES_H, *own})

    def lead_h(self, volume_m3: float, every_h: float, promise: EpochPromise) -> tuple[float, float]:
        """Return how long before its fall a moving block is noticed, h, to choose the interval between epochs.

        Parameters
        ----------
        volume_m3, every_h : float
            Volume of the block, m3, and interval between epochs, h.
        promise : EpochPromise
            What an epoch is predicted to show. It gives the displacement from which a block of this volume is listed.

        Returns
        -------
        (float, float)
            Cautious: the block moves until it is listed in 95 % of cases, and a whole interval passes until the next epoch.
            Typical: it moves until it is listed in 50 % of cases, and half an interval passes. 0 if the block falls before.
        """
        late = self.motion.time_left(promise.moved.displacement_m(volume_m3)[0]) - every_h
        usual = self.motion.time_left(promise.moved.displacement_m(volume_m3, 0.5)[0]) - every_h / 2
        return max(late, 0.0), max(usual, late, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return what the series is predicted to show as a dictionary for JSON, as plan.json stores it."""
        return {
            "sensor": self.sensor,
            "gsd_m": self.gsd_m,
            "every_h": self.every_h,
            "motion": self.motion.model_dump(include={"law", "lead_h", "displacement_m"}),
            "epochs": [self._epoch(each) for each in self.promises],
        }

    def _epoch(self, promise: EpochPromise) -> dict[str, Any]:
        """Return the promise of epochs of some scans for JSON."""
        value, low, high = promise.missing.volume_m3()
        curve = np.geomspace(value / 30, value * 30, _CURVE_POINTS)
        return {
            "scans": promise.scans,
            "level_of_detection_m": promise.level_m,
            "blocks": promise.missing.blocks,
            "seen_share": promise.missing.seen_share,
            "smallest_rockfall_m3": {"value": value, "interval_95": [low, high], "probability": PROBABILITY},
            "curve": {"volume_m3": curve.tolist(), "probability": promise.missing.probability(curve).tolist()},
            "laws": {
                "missing": promise.missing.coefficients.tolist(),
                "moved": promise.moved.coefficients.tolist(),
            },
            "precursors": [self._precursor(volume, promise) for volume in self.volumes_m3],
        }

    def _precursor(self, volume_m3: float, promise: EpochPromise) -> dict[str, Any]:
        """Return what is promised of a block that moves."""
        shows, low, high = promise.moved.displacement_m(volume_m3)
        leads = {every: self.lead_h(volume_m3, every, promise) for every in self.schedules_h}
        return {
            "volume_m3": volume_m3,
            "shows_from_m": {"value": shows, "interval_95": [low, high]},
            "schedules": [
                {"every_h": every, "lead_h_95": least, "lead_h_median": usual} for every, (least, usual) in leads.items()
            ],
        }


def plan_series(config: SimulationConfig, sensor: SensorName, progress: Progress | None = None) -> SeriesPlan:
    """Predict which rockfalls and moving blocks the series of a config will show with a sensor.

    It simulates trial epochs with blocks that have fallen or moved, and compares them with a reference as `monitor` does.

    Parameters
    ----------
    config : SimulationConfig
        A config with a section `series` in which rockfalls are simulated, and not meshes of the user (key `surfaces`).
    sensor : str
        "stereo" or "tls".
    progress : Progress, optional
        Object that is told which stage is running, to show it to the user.

    Raises
    ------
    InputError
        If the config simulates no rockfalls over time, the wall has no room for trial blocks, or the sensor sees too few.
    """
    if config.series is None or config.series.surfaces:
        raise InputError(
            "the config has no series of rockfalls",
            where="inspect --series",
            remedy="add `series:` with times and rockfall or events; see how to simulate a series",
        )
    progress = progress or Progress()
    random = KeyedRandom(config.seed)
    with progress.stage(f"{sensor}: wall"):
        site = prepare_site(config, sensor, random)
        trials = _Trials.of(config, config.series, site, random)
    motion, volumes = _motions(config.series)
    promises = []
    for scans in AVERAGED:
        missing, moved, level = _Sample(), _Sample(), list[float]()
        for number in range(_MOST_TRIALS):
            with progress.stage(f"{sensor}: trial {number + 1}, {scans} scans an epoch"):
                if missing.count < _ENOUGH:
                    level.append(trials.missing(number, scans, missing))
                if moved.count < _ENOUGH:
                    trials.moved(number, scans, level[0], volumes, moved)
        keyed = random.child("promise", scans)
        promises.append(
            EpochPromise(scans, float(np.median(level)), missing.law(keyed.child("missing")), moved.law(keyed.child("moved")))
        )
    times = config.series.times
    every = times.every_h if isinstance(times, RegularTimes) else None
    return SeriesPlan(sensor, trials.grid.gsd, every, tuple(promises), volumes, motion)


def _motions(series: SeriesConfig) -> tuple[Motion, tuple[float, ...]]:
    """Return the motion to judge, and the volumes of blocks that move: those by hand, else some of the law."""
    by_hand = [event for event in series.events if event.precursor is not None]
    motion = series.precursor or (by_hand[0].precursor if by_hand else None) or Motion()
    volumes = {event.volume_m3 for event in by_hand}
    if series.rockfall is not None:
        law = series.rockfall.volume_m3.power_law
        volumes |= {law.smallest, float(np.sqrt(law.smallest * law.largest)), law.largest}
    return motion, tuple(sorted(volumes or {0.2}))


class _Sample:
    """Collects blocks: volume, displacement, whether enough of it is seen, and whether the change was listed."""

    def __init__(self) -> None:
        self._rows: list[FloatArray] = []
        self._moved = False

    @property
    def count(self) -> int:
        """Number of blocks so far of which enough is seen."""
        return sum(int((rows[:, 2] >= _SEEN).sum()) for rows in self._rows)

    def add(self, volume_m3: FloatArray, moved_m: FloatArray | None, seen: FloatArray, listed: NDArray[np.bool_]) -> None:
        """Add blocks (k,). seen: shares; listed: whether `monitor` has an event there."""
        self._moved = moved_m is not None
        moved = np.ones(len(volume_m3)) if moved_m is None else moved_m
        self._rows.append(np.stack([volume_m3, moved, seen, listed], axis=1))

    def law(self, random: KeyedRandom) -> DetectionLaw:
        """Fit the detection law."""
        rows = np.concatenate(self._rows)
        used = rows[rows[:, 2] >= _SEEN]
        size = 3 if self._moved else 2
        if len(used) < _FEWEST:
            raise InputError(
                f"the sensor sees only {len(used)} of {len(rows)} simulated blocks (at least half of the volume of each)",
                where="inspect --series",
                allowed=f"{_FEWEST} blocks or more",
                remedy="move or turn the sensor so that it sees more of the wall; a map of `scarpsim inspect` shows what it sees",
            )
        design, listed = _design(used[:, 0], used[:, 1], size), used[:, 3]
        best = _fit(design, listed)
        generator = random.generator()
        draws = generator.integers(len(used), size=(_BOOTSTRAPS, len(used)))
        resampled = np.array([_fit(design[rows], listed[rows]) for rows in draws])
        return DetectionLaw(best, resampled, len(used), len(used) / len(rows))


@dataclass(frozen=True)
class _Trials:
    """Makes trial epochs.

    Attributes
    ----------
    series : Series
        The config's series: wall, sensor, conditions.
    grid : Grid
        Raster on which epochs are compared.
    reference : ReferenceHeights
        The reference as `monitor` sees it.
    bare : RayCaster
        The untouched wall.
    """

    series: Series
    grid: Grid
    reference: ReferenceHeights
    bare: RayCaster

    @classmethod
    def of(cls, config: SimulationConfig, given: SeriesConfig, site: SensorSite, random: KeyedRandom) -> _Trials:
        """Observe the reference and choose the raster as `monitor` does."""
        series = Series.of(config, given, site, random)
        points = _scanned(series, site.mesh, 0, 1, random.child("promise", "reference"))
        grid = raster_of(points, None)
        return cls(series, grid, ReferenceHeights.of(WallPoints.of(points), (grid,)), RayCaster(site.mesh))

    def missing(self, number: int, scans: int, sample: _Sample) -> float:
        """Make an epoch in which blocks are missing; returns the median level of detection, m."""
        keyed = self.series.random.child("promise", "missing", number)
        blocks = self._blocks(_SIDE_PX * self.grid.gsd, _SIDE_SIGMA, keyed)
        carved = carve(self.series.site.mesh, blocks)
        after = RayCaster(carved.mesh)
        label, known, listed, level = self._compared(carved.mesh, after, number, scans, keyed, "missing")
        lost = cast_raster(self.bare, self.grid).heights - cast_raster(after, self.grid).heights
        seen = _sums(np.where(known, np.nan_to_num(lost), 0.0), label, len(blocks)) * self.grid.gsd**2
        sample.add(carved.removed_volume_m3, None, seen / carved.removed_volume_m3, listed[1 : len(blocks) + 1])
        return level

    def moved(self, number: int, scans: int, level_m: float, volumes_m3: Sequence[float], sample: _Sample) -> None:
        """Make an epoch in which blocks have moved out by different amounts."""
        keyed = self.series.random.child("promise", "moved", number)
        sides = np.log(2 * np.asarray(volumes_m3)) / 3
        middle, spread = float(np.exp(sides.mean())), max(float(np.ptp(sides)) / 3, 0.15)
        wall = self.series.site.mesh
        blocks = self._blocks(middle, spread, keyed)
        low, high = np.log(np.multiply(_MOVED_LEVELS, level_m))
        moved = np.exp(keyed.child("displacement").generator().uniform(low, high, len(blocks)))
        carved, rocks = carve(wall, blocks), removed_rocks(wall, blocks)
        shift = np.append(0.0, moved)[np.zeros(0, dtype=int) if rocks.vertex_block is None else rocks.vertex_block]
        lifted = rocks.with_vertices(rocks.vertices + shift[:, None] * np.array([0.0, 0.0, 1.0]))
        bare = carved.mesh.submesh()
        mesh = joined_meshes([TriangleMesh(bare.vertices, bare.faces, bare.vertex_albedo), lifted])
        label, known, listed, _ = self._compared(mesh, RayCaster(mesh), number, scans, keyed, "added")
        pixels = np.maximum(_sums(np.ones(self.grid.shape), label, len(blocks)), 1)
        share = _sums(known.astype(np.float64), label, len(blocks)) / pixels
        sample.add(carved.removed_volume_m3, moved, share, listed[1 : len(blocks) + 1])

    def _blocks(self, side_m: float, sigma_log: float, random: KeyedRandom) -> Blocks:
        """Draw blocks of different sizes, apart from one another, with the shapes of the config."""
        own, wall = self.series.config.rockfall, self.series.site.mesh
        apart = _APART_PX * self.grid.gsd
        area = float(np.prod(np.ptp(wall.bounds[:, :2], axis=0)))
        count = int(np.clip(_FILLED * area / (side_m * np.exp(sigma_log) + apart) ** 2, 5, _MOST_BLOCKS))
        size = Lognormal(median=side_m, sigma_log=sigma_log)
        changed = own.model_copy(update={"count": count, "size_m": size, "minimum_distance_m": apart})
        return place_blocks(changed, wall, random, self.bare)

    def _compared(
        self, mesh: TriangleMesh, after: RayCaster, number: int, scans: int, random: KeyedRandom, kind: str
    ) -> tuple[IntArray, NDArray[np.bool_], NDArray[np.bool_], float]:
        """Observe a wall and compare it as `monitor` does.

        Returns the true labels (h, w), where the map has data (h, w), whether each label is listed as an event of this kind, and
        the median level of detection, m.
        """
        epoch = 1 + int(number * _GOLDEN % 1.0 * (self.series.series.count - 1))
        points = _scanned(self.series, mesh, epoch, scans, random.child("scan", scans))
        found = compare_epoch(self.reference, WallPoints.of(points), None, self.series.config.seed)
        label = after.labels_down(self.grid, np.zeros((*self.grid.shape, 2), dtype=np.float32))
        listed = np.zeros(int(label.max(initial=0)) + _MOST_BLOCKS + 1, dtype=bool)
        for region in found.regions:
            if region.kind == kind:
                listed[label[region.window][region.mask]] = True
        listed[WALL] = False
        (change,) = found.changes
        return label, np.isfinite(change.difference), listed, float(np.nanmedian(change.significance.level))


def _scanned(series: Series, mesh: TriangleMesh, epoch: int, scans: int, random: KeyedRandom) -> FloatArray:
    """Return the points (n, 3), wall frame, m, of some scans of a wall in the conditions of an epoch, one after another."""
    site = series.site_at(epoch)
    covered = series.covered(mesh, epoch)
    wet = series.config.wetness
    caster = RayCaster(covered if wet is None else wet.with_wet_patches(covered))
    seen = [acquire(series.config, site, caster, random.child(number)) for number in range(scans)]
    return np.concatenate([recorded_points(each.observations).points for each in seen])


def _sums(values: NDArray[np.floating], label: IntArray, count: int) -> FloatArray:
    """Return the sum (count,) of values (h, w) under each label from 1 on."""
    sums = np.bincount(np.minimum(label.ravel(), count + 1), values.ravel(), minlength=count + 2)
    return np.asarray(sums[1 : count + 1], dtype=np.float64)


def _design(volume_m3: FloatArray, moved_m: FloatArray, size: int) -> FloatArray:
    """Return the design matrix (..., size)."""
    columns = [np.ones_like(volume_m3, dtype=np.float64), np.log(volume_m3), np.log(moved_m) + np.zeros_like(volume_m3)]
    return np.stack(columns[:size], axis=-1)


def _logistic(value: FloatArray) -> FloatArray:
    """Return 1 / (1 + exp(-value)) without overflow."""
    return np.asarray(0.5 * (1 + np.tanh(value / 2)))


def _fit(design: FloatArray, listed: FloatArray) -> FloatArray:
    """Fit a logistic regression with a weak normal prior on standardised slopes, which keeps separable samples finite.

    Parameters
    ----------
    design : (n, p) array
        Its first column is 1.
    listed : (n,) array
        0 or 1.
    """
    from scipy.optimize import minimize

    centre, scale = design[:, 1:].mean(axis=0), np.maximum(design[:, 1:].std(axis=0), 1e-6)
    scaled = np.column_stack([design[:, 0], (design[:, 1:] - centre) / scale])

    def loss(fit: FloatArray) -> tuple[float, FloatArray]:
        value = scaled @ fit
        total = float(np.sum(np.logaddexp(0, value) - listed * value) + 0.5 * _PRIOR * np.sum(fit[1:] ** 2))
        return total, scaled.T @ (_logistic(value) - listed) + _PRIOR * np.append(0.0, fit[1:])

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="L-BFGS-B", bounds=[(-30, 30), *[(0.05, 30)] * len(scale)])
    slopes = found.x[1:] / scale
    return np.append(found.x[0] - slopes @ centre, slopes)


def _with_interval(law: DetectionLaw, value: Any) -> tuple[float, float, float]:
    """Return a function of the coefficients at the best fit, and its 95 % interval over the bootstrap."""
    low, high = np.quantile(value(law.resampled), [0.025, 0.975])
    return float(value(law.coefficients)), float(low), float(high)

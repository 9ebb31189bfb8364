"""Compute the results of a comparison for each sensor and for measured epochs.

They are the noise, the level of detection, the detected blocks and the completeness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.difference import DifferenceStatistics, statistics
from pipeline.comparison.detection import (
    LEAST_CELL_PIXELS,
    BlockDetection,
    BlockMeanTest,
    detect_blocks,
    false_alarms,
    footprints,
    level_of_detection,
    wilson_interval,
)
from pipeline.comparison.detection_curve import DetectionCurve, detection_curve
from pipeline.comparison.trial import SensorObservations, Trial
from pipeline.noise.measured import MeasuredMaps
from pipeline.noise.statistics import (
    BinStatistics,
    DensityHistogram,
    Normality,
    TailFigures,
    histogram,
    normality,
    quantile_edges,
    statistics_by_bin,
    tail_figures,
    without_outliers,
)
from pipeline.noise.variogram import Variogram, VariogramModel, effective_sample_size, fit_variogram, variogram
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

Raster = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
_CELL_M = 0.5
"""Side of the cells for which the level of detection is computed, m."""
_MOST_BINNED = 4_000_000
"""Largest number of differences sorted into bins of a covariate; of more, a regular subsample is used."""
_VARIOGRAM_MAPS = 4
"""Number of epochs that the variogram is computed from."""
_EDGE_STEPS_PX = (0, 1, 2, 4, 8, 16, 32, 64)
"""Bin edges of the distance from rock edges, pixels."""
_SIZE_CLASSES = 8
"""Number of classes of block size and of block depth."""


@dataclass(frozen=True)
class MapNoise:
    """Noise of several difference maps of one sensor over stable ground, where nothing fell.

    Attributes
    ----------
    stable : Statistics (median, NMAD, ...) of the differences of all epochs together, m.
    per_epoch : The same statistics of each epoch.
    tails, normality, histogram : Shape of the distribution: its quantiles and kurtosis, a test for normality, and a histogram.
    variogram, model : Empirical variogram of the differences within five NMAD of their median, and the model fitted to it.
    effective : Number of independent pixels (effective sample size) among the stable pixels of the first map.
    pixels : Number of stable pixels of the first map.
    level : (h, w) level of detection of each pixel, m: the absolute difference that noise alone exceeds in 5 % of cases.
    """

    stable: DifferenceStatistics
    per_epoch: list[DifferenceStatistics]
    tails: TailFigures
    normality: Normality
    histogram: DensityHistogram
    variogram: Variogram
    model: VariogramModel
    effective: float
    pixels: int
    level: Raster

    @property
    def median_level_m(self) -> float | None:
        """Median of the pixels' levels of detection (difference that noise exceeds in 5 % of cases), m; None without any."""
        known = self.level[~np.isnan(self.level)]
        return float(np.median(known)) if known.size else None

    def to_dict(self) -> dict[str, Any]:
        """Return statistics, tails, variogram and median level of detection of one sensor's noise for `comparison.json`."""
        return {
            "stable": self.stable.to_dict(),
            "per_epoch": [each.to_dict() for each in self.per_epoch],
            "tails": self.tails.to_dict(),
            "normality": self.normality.to_dict(),
            "variogram": self.variogram.to_dict(),
            "variogram_model": self.model.to_dict(),
            "effective_sample_size": self.effective,
            "pixels": self.pixels,
            "level_of_detection_median_m": self.median_level_m,
        }


@dataclass(frozen=True)
class DetectionClass:
    """How many of the fallen blocks in one class of size (or depth) a sensor detected, and how well it measured their volumes.

    Attributes
    ----------
    low_m, high_m : The class [low_m, high_m) of size or depth, m.
    blocks, seen : Number of blocks in the class, and of those detected.
    interval : 95 % confidence interval of the share detected, from 0 to 1.
    volume_error, volume_spread : Median and NMAD over the blocks of (measured volume / true volume - 1); None without blocks.
    """

    low_m: float
    high_m: float
    blocks: int
    seen: int
    interval: tuple[float, float]
    volume_error: float | None
    volume_spread: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return numbers of blocks, interval and volume error of one class of block sizes as a dictionary for JSON and CSV."""
        return {
            "low_m": self.low_m,
            "high_m": self.high_m,
            "blocks": self.blocks,
            "seen": self.seen,
            "share_low": self.interval[0],
            "share_high": self.interval[1],
            "volume_error": self.volume_error,
            "volume_spread": self.volume_spread,
        }


@dataclass(frozen=True)
class DetectionSummary:
    """Which of the fallen blocks a sensor detected, and its false alarms.

    A block is in view if the sensor, before the block fell, saw at least half of the wall that its fall changed.

    Attributes
    ----------
    blocks : All blocks that fell.
    by_size, by_depth : Probability of detection of the blocks in view against size and against depth; None for fewer than ten.
    size_classes, depth_classes : Counts of the blocks in view by classes of size and of depth.
    table : (size classes, depth classes) share of the blocks detected; NaN where no block is in both classes.
    alarms, trials : As a check, block outlines were placed on stable ground `trials` times, and `alarms` were taken for
        blocks.
    """

    blocks: list[BlockDetection]
    by_size: DetectionCurve | None
    by_depth: DetectionCurve | None
    size_classes: list[DetectionClass]
    depth_classes: list[DetectionClass]
    table: FloatArray
    alarms: int
    trials: int

    def to_dict(self) -> dict[str, Any]:
        """Return counts, detection curves and false alarms of one sensor for `comparison.json`; blocks.csv has the blocks."""
        return {
            "blocks": len(self.blocks),
            "in_view": sum(block.in_view for block in self.blocks),
            "seen": sum(block.seen for block in self.blocks),
            "by_size": None if self.by_size is None else self.by_size.to_dict(),
            "by_depth": None if self.by_depth is None else self.by_depth.to_dict(),
            "size_classes": [each.to_dict() for each in self.size_classes],
            "depth_classes": [each.to_dict() for each in self.depth_classes],
            "false_alarms": self.alarms,
            "false_alarm_trials": self.trials,
        }


@dataclass(frozen=True)
class SensorAssessment:
    """All results of one sensor in a comparison of sensors: noise, errors, detected blocks, completeness and effort.

    Attributes
    ----------
    name, sensor : Name in the comparison; "stereo" or "tls" (laser scanner).
    noise : Noise over stable ground, where nothing fell.
    wall : Statistics of measured minus true change on the whole wall, places of fallen blocks included, m.
    by : For each covariate (such as "range_m"), statistics of the differences over stable ground in bins of it.
    detection : Which fallen blocks were detected.
    visible : Share of the wall that the sensor can see, 0 to 1.
    complete, complete_of_visible, complete_of_hidden : Share of pixels with data, mean over the epochs: of the whole wall, of
        the part that the sensor can see, and of the part that it cannot, where triangles bridge a gap.
    points : Number of points of the reference epoch.
    scan_seconds : Duration of the measurement of one epoch, s; None for cameras.
    seconds : Mean computing time of an epoch, s.
    registration_rms_m : Mean RMS distance of ICP's inliers, m; None without ICP.
    """

    name: str
    sensor: str
    noise: MapNoise
    wall: DifferenceStatistics
    by: dict[str, list[BinStatistics]]
    detection: DetectionSummary
    visible: float
    complete: float
    complete_of_visible: float
    complete_of_hidden: float
    points: int
    scan_seconds: float | None
    seconds: float
    registration_rms_m: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return all results of one sensor as a dictionary for `comparison.json`."""
        return {
            "name": self.name,
            "sensor": self.sensor,
            "noise": self.noise.to_dict(),
            "wall": self.wall.to_dict(),
            "by": {name: [each.to_dict() for each in bins] for name, bins in self.by.items()},
            "detection": self.detection.to_dict(),
            "visible": self.visible,
            "complete": self.complete,
            "complete_of_visible": self.complete_of_visible,
            "complete_of_hidden": self.complete_of_hidden,
            "points": self.points,
            "scan_seconds": self.scan_seconds,
            "seconds_per_epoch": self.seconds,
            "registration_rms_m": self.registration_rms_m,
        }


def map_noise(stable: Raster, gsd_m: float, random: KeyedRandom) -> MapNoise:
    """Compute the noise of several difference maps of one sensor: statistics, distribution, variogram and level of detection.

    Parameters
    ----------
    stable : (e, h, w) differences of e epochs, m; NaN outside stable ground and without data.
    gsd_m : Pixel size, m.
    random : Source of the random subsample for the normality test.
    """
    found = variogram(np.stack([without_outliers(each) for each in stable[:_VARIOGRAM_MAPS]]), gsd_m)
    model = fit_variogram(found)
    known = ~np.isnan(stable[0])
    effective = effective_sample_size(model, known, gsd_m) if known.any() else 0.0
    return MapNoise(
        stable=statistics(stable),
        per_epoch=[statistics(each) for each in stable],
        tails=tail_figures(stable),
        normality=normality(stable[0], effective, random.child("normality")),
        histogram=histogram(stable),
        variogram=found,
        model=model,
        effective=effective,
        pixels=int(np.count_nonzero(known)),
        level=level_of_detection(stable, _cell_px(stable, gsd_m)),
    )


def _cell_px(stable: Raster, gsd_m: float) -> int:
    """Return the side of the level of detection's cells, pixels: half a metre, or more where the data is sparse."""
    per_pixel = max(float(np.mean(~np.isnan(stable))) * len(stable), 1e-6)
    enough = int(np.ceil(np.sqrt(2 * LEAST_CELL_PIXELS / per_pixel)))
    return min(max(round(_CELL_M / gsd_m), enough), max(stable.shape[1:]))


def assess(trial: Trial, seen: SensorObservations, random: KeyedRandom) -> SensorAssessment:
    """Compute all results of one sensor in a comparison: noise, detected blocks, completeness and effort.

    Parameters
    ----------
    trial : The simulated comparison, with the true changes of the wall.
    seen : The difference maps and other observations of this sensor.
    random : Source of random subsamples, and of the places on stable ground where false alarms are counted.
    """
    gsd = trial.grid.gsd
    random = random.child("compare", seen.setup.name)
    stable = np.where(np.stack([epoch.stable for epoch in trial.epochs]), seen.changes, np.nan).astype(np.float32)
    errors = np.stack([change - epoch.change for change, epoch in zip(seen.changes, trial.epochs, strict=True)])
    noise = map_noise(stable, gsd, random)
    data, surface = ~np.isnan(seen.changes), trial.wall.found
    in_view, hidden = seen.visible & surface, surface & ~seen.visible
    return SensorAssessment(
        name=seen.setup.name,
        sensor=seen.setup.sensor,
        noise=noise,
        wall=statistics(errors),
        by=_by_covariates(stable, trial, seen),
        detection=_detection(trial, seen, stable, BlockMeanTest(noise.model, noise.level, gsd), random),
        visible=float(np.mean(in_view[surface])),
        complete=float(np.mean(data[:, surface])),
        complete_of_visible=float(np.mean(data[:, in_view])) if in_view.any() else 0.0,
        complete_of_hidden=float(np.mean(data[:, hidden])) if hidden.any() else 0.0,
        points=seen.points[0],
        scan_seconds=_scan_seconds(seen),
        seconds=float(np.mean(seen.seconds)),
        registration_rms_m=float(np.mean(seen.registration_rms_m)) if seen.registration_rms_m else None,
    )


def assess_measured(found: MeasuredMaps, random: KeyedRandom) -> MapNoise:
    """Compute the noise of really measured epochs, to compare it with that of simulated sensors.

    It is computed over the measurement's stable areas. Without such areas, it is computed over all differences within five
    NMADs of their median.

    Parameters
    ----------
    found : Difference maps of the measured epochs.
    random : Source of the random subsample for the normality test.
    """
    stable = (
        np.where(found.stable, found.maps, np.nan)
        if found.stable is not None
        else np.stack(list(map(without_outliers, found.maps)))
    )
    return map_noise(stable.astype(np.float32), found.grid.gsd, random.child("measured", found.name))


def _scan_seconds(seen: SensorObservations) -> float | None:
    """Return how long the scanner measures from all its stations, s; None for cameras."""
    looks = seen.reference.observations
    if looks[0].pulse_interval_s is None:
        return None
    return float(sum(each.depth.size * (each.pulse_interval_s or 0.0) for each in looks))


def _by_covariates(stable: Raster, trial: Trial, seen: SensorObservations) -> dict[str, list[BinStatistics]]:
    """Compute statistics of the stable differences by range, incidence angle, distance from edges, and albedo."""
    step = int(np.ceil(np.sqrt(stable.size / _MOST_BINNED)))
    part = stable[:, ::step, ::step]

    def against(covariate: NDArray[np.floating], edges: FloatArray | None = None) -> list[BinStatistics]:
        thinned = covariate[::step, ::step]
        return statistics_by_bin(part, np.broadcast_to(thinned, part.shape), quantile_edges(thinned) if edges is None else edges)

    edge_bins = np.array([*_EDGE_STEPS_PX, np.inf]) * trial.grid.gsd
    incidence = np.radians([0, 10, 20, 30, 40, 50, 60, 70, 80, 90])
    return {
        "range_m": against(seen.range_m),
        "incidence_rad": against(seen.incidence_rad, incidence),
        "edge_m": against(trial.wall.edge_m, edge_bins),
        "albedo": against(trial.wall.albedo),
    }


def _detection(
    trial: Trial, seen: SensorObservations, stable: Raster, test: BlockMeanTest, random: KeyedRandom
) -> DetectionSummary:
    """Test every block of every epoch, and the same footprints on stable ground."""
    blocks: list[BlockDetection] = []
    alarms = trials = 0
    for number, (epoch, change) in enumerate(zip(trial.epochs, seen.changes, strict=True)):
        blocks += detect_blocks(epoch.number, change, epoch.block, epoch.change, epoch.records, seen.visible, test)
        shapes = [shape for _, _, shape in footprints(epoch.block, epoch.change)]
        found, of = false_alarms(stable[number], shapes, test, random.child("alarms", number))
        alarms, trials = alarms + found, trials + of
    shown = [block for block in blocks if block.in_view]
    size, depth = (np.array([getattr(block, name) for block in shown]) for name in ("size_m", "depth_m"))
    hit = np.array([block.seen for block in shown], dtype=bool)
    return DetectionSummary(
        blocks,
        detection_curve(size, hit),
        detection_curve(depth, hit),
        size_classes(shown, size, class_edges(size)),
        size_classes(shown, depth, class_edges(depth)),
        _table(size, depth, hit),
        alarms,
        trials,
    )


def class_edges(values: FloatArray, classes: int = _SIZE_CLASSES) -> FloatArray:
    """Return the edges of classes of equal logarithmic width that cover all values, to count blocks by size or depth.

    Parameters
    ----------
    values : (k,) positive values, such as block sizes, m.
    classes : Number of classes.

    Returns
    -------
    (classes + 1,) edges, ascending, in the unit of the values. Without values there is a single class from 0.01 to 1.
    """
    if len(values) == 0:
        return np.array([0.01, 1.0])
    low, high = float(values.min()), float(values.max())
    return np.geomspace(low, max(high, low * 1.01) * (1 + 1e-9), classes + 1)


def size_classes(blocks: list[BlockDetection], values: FloatArray, edges: FloatArray) -> list[DetectionClass]:
    """Sort fallen blocks into classes of size or depth, and compute for each class how many were detected.

    Parameters
    ----------
    blocks : The k blocks.
    values : (k,) their sizes or depths, m.
    edges : Edges of the classes, ascending, m.

    Returns
    -------
    One result for each class.
    """
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return [
        _class(float(edges[i]), float(edges[i + 1]), [blocks[k] for k in np.flatnonzero(place == i)])
        for i in range(len(edges) - 1)
    ]


def _class(low: float, high: float, blocks: list[BlockDetection]) -> DetectionClass:
    """Compute the share detected and the volume error of one class."""
    seen = sum(block.seen for block in blocks)
    ratio = np.array([block.measured_volume_m3 / block.volume_m3 - 1 for block in blocks if block.volume_m3 > 0])
    size = statistics(ratio)
    error = (size.median, size.nmad) if size.count else (None, None)
    return DetectionClass(low, high, len(blocks), seen, wilson_interval(seen, len(blocks)), *error)


def _table(size: FloatArray, depth: FloatArray, hit: BoolArray) -> FloatArray:
    """Return the (sizes, depths) share detected in each class of both; NaN without blocks."""
    edges = class_edges(size), class_edges(depth)
    count, _, _ = np.histogram2d(size, depth, edges)
    seen, _, _ = np.histogram2d(size[hit], depth[hit], edges)
    return np.divide(seen, count, out=np.full(count.shape, np.nan), where=count > 0)


def shared_scale_m(noises: list[MapNoise]) -> float:
    """Return the size of the noise by which all maps in a comparison of sensors are coloured, m, so that they can be compared.

    noises: the noise of each sensor. The result is the largest of their NMADs, so that the map of none saturates.
    """
    return max((each.stable.nmad for each in noises if each.stable.count), default=1e-3) or 1e-3


def grid_record(grid: Grid) -> dict[str, float]:
    """Return the origin (m), pixel size (m) and shape (pixels) of the raster of all difference maps, for `comparison.json`."""
    return {"x_min_m": grid.x_min, "y_max_m": grid.y_max, "gsd_m": grid.gsd, "width_px": grid.width, "height_px": grid.height}

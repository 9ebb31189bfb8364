"""Find regions that changed, and follow them from epoch to epoch.

A region begins where the mean difference over a small square is far beyond its error, and grows over neighbouring pixels of the
same sign that exceed half their level of detection. Its volume is the sum of the differences, its standard deviation that of the
mean over so many pixels, with the registration's, times the area. Where an edge was sampled differently, one point changes 3 x 3
pixels. So a region has to be significant without those about its deepest one too, and its volume has to exceed its standard
deviation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.monitoring.gridding import HeightRaster
from pipeline.monitoring.raster_statistics import mean_over_squares
from pipeline.monitoring.significance import Significance
from scene.geometry.grid import Grid

Kind = Literal["missing", "added"]
_SQUARES_PX = (3, 5, 9)
_BEGINS = 7.0
"""Standard deviations by which the mean over a square must differ from zero for a region to begin."""
_GROWS = 0.5
"""Share of the level of detection that pixels at a region's rim exceed."""
LEAST_PIXELS = 16
SIGNIFICANT = 7.0
"""Standard deviations by which the mean over a whole region must differ from zero."""
_SIGNIFICANT_BESIDE = 5.0
"""The same without the 3 x 3 pixels about the deepest one."""
INSIGNIFICANT = "insignificant"
"""The mark of a detection that noise or an edge may explain wholly."""
_STEEP = 4.0
"""Tangent of the angle to the wall's plane beyond which heights are those of an edge (76 degrees)."""
_SCATTERED = 3.0
"""Times the wall's usual scatter of points about the surface from which a region is rough: vegetation or an edge."""
_OTHER_SIGN = 0.2
_THIN_PX = 1.2
"""Area over length of the outline, pixels, below which a region is a thin line."""
_MARGIN_PX = 2
"""Pixels without data in bays of a region that are at most twice as wide are counted to it."""
_ISLAND = 0.3
"""Share of the largest part of a mask below which another part is no part of the outline."""
_EDGE_PX = 5
"""Side of the square about a pixel in which an edge of the rock would be spread."""
_NOISE_LEVELS, _NOISE_SHARE = 2.0, 0.35
"""Times the level of detection, and share of the region's largest depth: a pixel below both is noise beside the region, over
which it grew, and not part of the outline."""
_EDGE_SHARE = 0.35
"""Share of the largest depth in that square from which a pixel belongs to the outline. A vertical face, spread over 3 x 3 pixels,
then keeps its place, and blocks that taper off towards their outline lose about 10 % of their area."""
_GAP_SHARE, _RIM_SHARE = 1.0, 1.3
"""Shares of the volume in pixels without data, and in the pixels along the outline, that are taken as one standard deviation of
it. They are set so that the intervals of simulated rockfalls hold the truth as often as they say (docs/validation/monitor.md)."""
_SAME_PLACE = 0.3
"""Share of the smaller of two regions that lies in the other if both are one event."""


@dataclass(frozen=True)
class ChangedRegion:
    """A connected part of the wall that changed between the reference and an epoch.

    Attributes
    ----------
    kind : "missing" or "added"
        Whether rock is missing or material was added.
    row, column : int
        Pixel of the difference map at which the mask's top-left pixel lies.
    mask : (m, n) bool array
        Pixels of the region, within its bounding box.
    x_m, y_m, z_m : float
        Centre of the mask and the reference's median height there, wall frame, m.
    width_m, height_m, area_m2 : float
        Size of the mask, in the plane of the wall, m and m2.
    depth_median_m, depth_largest_m : float
        Median and largest change along the wall's normal, m, positive for both kinds.
    volume_m3, volume_std_m3 : float
        Volume, positive for both kinds, and its standard deviation, m3.
    significance : float
        Mean change divided by its standard deviation.
    score : float
        A detector's score of the detection, 0 to 1; NaN without a detector.
    marks : tuple of str
        "edge", "vegetation", "thin": another explanation of the change; "insignificant": a detection that noise or an
        edge may explain wholly.
    identity : int
        Number of the event, which regions of several epochs at one place share; 0 if it is not yet known.
    view : int
        Number of the view (separately mapped part of the wall) in whose map it lies, from 1 on.
    """

    kind: Kind
    row: int
    column: int
    mask: NDArray[np.bool_] = field(repr=False)
    x_m: float
    y_m: float
    z_m: float
    width_m: float
    height_m: float
    area_m2: float
    depth_median_m: float
    depth_largest_m: float
    volume_m3: float
    volume_std_m3: float
    significance: float
    score: float = float("nan")
    marks: tuple[str, ...] = ()
    identity: int = 0
    view: int = 1

    @property
    def window(self) -> tuple[slice, slice]:
        """Slices of the rows and columns of the difference map that the region's bounding box covers."""
        height, width = self.mask.shape
        return slice(self.row, self.row + height), slice(self.column, self.column + width)

    def numbers(self) -> dict[str, Any]:
        """Return the region's attributes except the mask, as JSON and tables store them.

        Keys are the names of the attributes, except that `identity` has the key "id".
        """
        names = (
            "kind", "row", "column", "x_m", "y_m", "z_m", "width_m", "height_m", "area_m2", "depth_median_m", "depth_largest_m",
            "volume_m3", "volume_std_m3", "significance", "score",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names} | {
            "marks": list(self.marks),
            "id": self.identity,
            "view": self.view,
        }


@dataclass(frozen=True)
class Change:
    """Difference map between the reference and one registered epoch for one view of the wall, with its uncertainty.

    Attributes
    ----------
    difference : (h, w) float32 array
        Height of the reference minus that of the epoch, m: positive where rock is missing.
    significance : Significance
        Level of detection of each pixel, and standard deviations of means over several pixels.
    registration : (h, w) float32 array
        Standard deviation of the difference that comes from the registration, m.
    reference, epoch : HeightRaster
        Heights of the two epochs; the epoch's are those before the final registration.
    """

    difference: NDArray[np.float32]
    significance: Significance
    registration: NDArray[np.float32]
    reference: HeightRaster
    epoch: HeightRaster

    @property
    def grid(self) -> Grid:
        """Raster of the difference map and of its levels of detection."""
        return self.reference.grid


def find_regions(change: Change) -> list[ChangedRegion]:
    """Find the connected regions of a difference map whose change noise cannot explain, the largest volume first.

    change: the difference map with its levels of detection.
    """
    standard = change.difference / change.significance.one_sigma
    begins = _begins(standard, change.significance)
    beyond = np.abs(change.difference) > _GROWS * change.significance.level
    regions: list[ChangedRegion] = []
    for sign, kind, begun in ((1.0, "missing", begins[0]), (-1.0, "added", begins[1])):
        if not begun.any():
            continue
        labels, count = ndimage.label(beyond & (sign * standard > 0))
        wanted = np.unique(labels[begun & (labels > 0)]).tolist()
        boxes = ndimage.find_objects(labels, count) if wanted else []
        for number in wanted:
            if (box := boxes[number - 1]) is not None:
                regions += _kept(labels[box] == number, box[0].start, box[1].start, kind, change)
    return sorted(regions, key=lambda region: -region.volume_m3)


def region_of_mask(mask: NDArray[np.bool_], row: int, column: int, score: float, change: Change) -> ChangedRegion | None:
    """Measure depth, volume and significance of a detection in a difference map.

    Parameters
    ----------
    mask : (m, n) bool array
        Pixels of the detection, within its bounding box.
    row, column : int
        Pixel of the difference map at which the mask's top-left pixel lies.
    score : float
        The detector's score of the detection, 0 to 1.
    change : Change
        The difference map with its levels of detection.

    Returns
    -------
    ChangedRegion or None
        None if the map has no data in the mask.
    """
    window = change.difference[row : row + mask.shape[0], column : column + mask.shape[1]]
    known = mask & np.isfinite(window)
    if not known.any():
        return None
    kind: Kind = "missing" if window[known].mean() >= 0 else "added"
    return replace(_measured(known, row, column, kind, change), score=score)


def _begins(standard: NDArray[np.floating], significance: Significance) -> NDArray[np.bool_]:
    """(2, h, w) where the mean over a square about the pixel is far beyond its error: above it, and below minus it."""
    known = np.isfinite(standard)
    filled = np.where(known, standard, 0.0)
    found = np.zeros((2, *standard.shape), dtype=bool)
    for side in _SQUARES_PX:
        share = mean_over_squares(known.astype(np.float32), side)
        mean = mean_over_squares(filled.astype(np.float32), side) / np.maximum(share, 1e-6)
        least, filled_square = _BEGINS * significance.sigma_of_mean(side**2), share > 0.5
        found[0] |= (mean > least) & filled_square
        found[1] |= (mean < -least) & filled_square
    return found


def _kept(mask: NDArray[np.bool_], row: int, column: int, kind: str, change: Change) -> Iterator[ChangedRegion]:
    """The region of a mask, where it is large and significant enough."""
    if int(mask.sum()) < LEAST_PIXELS:
        return
    region = _measured(mask, row, column, "missing" if kind == "missing" else "added", change)
    if INSIGNIFICANT not in region.marks:
        yield region


def _measured(mask: NDArray[np.bool_], row: int, column: int, kind: Kind, change: Change) -> ChangedRegion:
    """Measure the region of a mask whose pixels all have data.

    Volume and significance are those of the whole mask. Heights come from 3 x 3 pixels, so that a sharp edge is spread over
    neighbouring ones: outline and area are those of the pixels with at least `_EDGE_SHARE` of the largest depth around them, and
    the median depth is that of the pixels with at least half of it.
    """
    row, column, mask = _padded(mask, row, column, change.difference.shape)
    window = (slice(row, row + mask.shape[0]), slice(column, column + mask.shape[1]))
    grid, gsd, sign = change.grid, change.grid.gsd, 1.0 if kind == "missing" else -1.0
    whole, depth = _with_gaps_filled(mask, sign * change.difference[window].astype(np.float64))
    pixels = int(whole.sum())
    sigmas, shifts = (values[window].astype(np.float64) for values in (change.significance.one_sigma, change.registration))

    def noise(part: NDArray[np.bool_]) -> float:
        """Return the standard deviation of the mean change of some pixels, m."""
        independent = float(sigmas[part].mean() * change.significance.sigma_of_mean(int(part.sum())))
        return max(float(np.hypot(independent, np.sqrt(np.mean(shifts[part] ** 2)))), 1e-9)

    def significance(part: NDArray[np.bool_]) -> float:
        return float(depth[part].mean()) / noise(part) if part.any() else 0.0

    rim = whole & ~ndimage.binary_erosion(whole)
    rough = _GAP_SHARE * depth[whole & ~mask].sum(), _RIM_SHARE * np.abs(depth[rim]).sum()
    deepest = ndimage.grey_dilation(np.where(whole, depth, 0.0), size=(_EDGE_PX, _EDGE_PX))
    level = _NOISE_LEVELS * change.significance.level[window][mask].astype(np.float64).mean()
    least = min(level, _NOISE_SHARE * float(depth[whole].max()))
    inner = _without_islands(whole & (depth >= np.maximum(_EDGE_SHARE * deepest, least)))
    rows, columns = np.nonzero(inner)
    volume = float(depth[whole].sum()) * gsd**2
    volume_std = float(np.sqrt((noise(mask) * pixels) ** 2 + rough[0] ** 2 + rough[1] ** 2)) * gsd**2
    doubtful = significance(_without_deepest(mask, depth)) < _SIGNIFICANT_BESIDE or volume < volume_std
    insignificant = (INSIGNIFICANT,) if doubtful or significance(mask) < SIGNIFICANT else ()
    return ChangedRegion(
        kind=kind,
        row=row,
        column=column,
        mask=inner,
        x_m=grid.x_min + (column + float(columns.mean()) + 0.5) * gsd,
        y_m=grid.y_max - (row + float(rows.mean()) + 0.5) * gsd,
        z_m=float(np.median(change.reference.height[window][mask])),
        width_m=(int(columns.max()) - int(columns.min()) + 1) * gsd,
        height_m=(int(rows.max()) - int(rows.min()) + 1) * gsd,
        area_m2=int(inner.sum()) * gsd**2,
        depth_median_m=float(np.median(depth[inner & (depth >= deepest / 2)])),
        depth_largest_m=float(depth[inner].max()),
        volume_m3=volume,
        volume_std_m3=volume_std,
        significance=significance(mask),
        marks=(*_marks(mask, window, sign, change), *insignificant),
    )


def _without_deepest(mask: NDArray[np.bool_], depth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Drop the 3 x 3 pixels about the deepest one of a mask."""
    row, column = np.unravel_index(np.argmax(np.where(mask, depth, -np.inf)), mask.shape)
    rest = mask.copy()
    rest[max(int(row) - 1, 0) : int(row) + 2, max(int(column) - 1, 0) : int(column) + 2] = False
    return rest


def _without_islands(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop parts of a mask that are much smaller than its largest one."""
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    if count < 2:
        return mask
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray((sizes >= _ISLAND * sizes.max())[labels] & mask)


def _padded(mask: NDArray[np.bool_], row: int, column: int, shape: tuple[int, ...]) -> tuple[int, int, NDArray[np.bool_]]:
    """Return the mask with a margin inside the map, and its top-left pixel."""
    top, left = min(_MARGIN_PX, row), min(_MARGIN_PX, column)
    bottom = min(_MARGIN_PX, shape[0] - row - mask.shape[0])
    right = min(_MARGIN_PX, shape[1] - column - mask.shape[1])
    return row - top, column - left, np.pad(mask, ((top, bottom), (left, right)))


def _with_gaps_filled(mask: NDArray[np.bool_], depth: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Add pixels without data inside a region or in its small bays, with the depth of the nearest pixel of the region."""
    closed = ndimage.binary_closing(np.pad(mask, _MARGIN_PX), np.ones((3, 3)), iterations=_MARGIN_PX)
    closed = ndimage.binary_fill_holes(closed)[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX]
    whole = mask | (closed & ~np.isfinite(depth))
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return whole, np.where(mask, depth, depth[tuple(nearest)])


def _marks(mask: NDArray[np.bool_], window: tuple[slice, slice], sign: float, change: Change) -> tuple[str, ...]:
    """Name what else may explain the change."""
    marks = []
    edge = np.zeros(mask.shape, dtype=bool)
    rough = []
    for raster in (change.reference, change.epoch):
        edge |= raster.steepness[window] > _STEEP
        usual = float(np.nanmedian(raster.scatter))
        rough.append(float(np.nanmedian(raster.scatter[window][mask])) > _SCATTERED * usual)
    if float(edge[mask].mean()) > 0.5:
        marks.append("edge")
    around = np.isfinite(change.difference[window]) & ~mask
    strong = np.abs(change.difference[window]) > change.significance.level[window]
    other = around & strong & (sign * change.difference[window] < 0)
    if all(rough) or (any(rough) and other.sum() > _OTHER_SIGN * mask.sum()):
        marks.append("vegetation")
    if _is_thin(mask):
        marks.append("thin")
    return tuple(marks)


def _is_thin(mask: NDArray[np.bool_]) -> bool:
    outline = mask & ~ndimage.binary_erosion(np.pad(mask, 1))[1:-1, 1:-1]
    return float(mask.sum()) / max(int(outline.sum()), 1) < _THIN_PX


class Catalogue:
    """Numbers the events of a wall over all epochs.

    An event is a change at one place: a region that overlaps one of an earlier epoch, of the same kind, belongs to its event.
    """

    def __init__(self) -> None:
        self._last: dict[int, ChangedRegion] = {}

    def identified(self, regions: Sequence[ChangedRegion]) -> list[ChangedRegion]:
        """Return the changed regions of the next epoch with the numbers of their events (changes at one place over all epochs).

        A region that overlaps one of the same kind in an earlier epoch gets that one's number; others get the next free
        numbers.
        """
        named, taken = [], set()
        for region in sorted(regions, key=lambda each: -each.volume_m3):
            shared = {
                number: _shared_share(region, other)
                for number, other in self._last.items()
                if number not in taken and other.kind == region.kind
            }
            number = max(shared, key=lambda each: shared[each], default=0)
            if not number or shared[number] < _SAME_PLACE:
                number = max(self._last, default=0) + 1
            region = replace(region, identity=number)
            taken.add(number)
            self._last[number] = region
            named.append(region)
        return sorted(named, key=lambda each: -each.volume_m3)


def _shared_share(one: ChangedRegion, other: ChangedRegion) -> float:
    """Pixels that two regions share, over those of the smaller one."""
    if one.view != other.view:
        return 0.0
    top, left = max(one.row, other.row), max(one.column, other.column)
    bottom = min(one.row + one.mask.shape[0], other.row + other.mask.shape[0])
    right = min(one.column + one.mask.shape[1], other.column + other.mask.shape[1])
    if bottom <= top or right <= left:
        return 0.0
    parts = [each.mask[top - each.row : bottom - each.row, left - each.column : right - each.column] for each in (one, other)]
    return float((parts[0] & parts[1]).sum()) / min(int(one.mask.sum()), int(other.mask.sum()))

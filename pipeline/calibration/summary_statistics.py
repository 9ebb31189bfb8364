"""Compute the summary statistics by which measured and simulated noise are compared: size and spatial pattern.

All statistics are logarithms of lengths, m, pooled over the epochs, so that a calibration compares ratios. For windows k of maps
e, m_ek is the median of a window and r = d - m_ek its residuals:

    size         StD, NMAD and half the width between the 2.5 % and 97.5 % quantiles of r: the marginal distribution
    variogram    sqrt(gamma(h)) of r at distances h along rows and columns, by Cressie and Hawkins (1980), which is robust to
                 steps: gamma = (mean |r - r'|^(1/2))^4 / (2 (0.457 + 0.494/N))
    deformation  RMS of m_ek in polynomials of degree 2 (bending) and 3 (twisting) over the wall, orthonormal on the windows'
                 centres, and the RMS of the rest; planes are left out, as registration removes them
    edges        StD and NMAD of r where the surface is steep (the steepest tenth of the pixels), StD elsewhere
    incidence    NMAD of r in thirds of the remaining pixels, by incidence angle of the line of sight

A large-scale mode has only one draw per epoch, the other statistics have many; the covariance over simulations accounts for that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.calibration.windows import Windows
from pipeline.change.robust import nmad
from scene.geometry.mesh import FloatArray

_LAGS_PX = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Distances of the variogram, pixels."""
_STEEP = 0.9
"""Quantile of the slope from which a pixel counts as steep."""
_FLOOR_M = 1e-6
"""Added to every length, so that a noiseless model has finite logarithms."""
_LEAST_IN_CLASS = 10
"""Values that a NMAD needs."""


@dataclass(frozen=True)
class SummaryStatistics:
    """Summarises the noise of difference maps by a few statistics, in which a calibration compares measured and simulated maps.

    Heights and line of sight serve to compute the noise at edges and by the angle of incidence.

    Attributes
    ----------
    windows : The k square parts of the maps, n by n pixels each, in which maps are compared.
    heights : (k, n, n) heights (z) of the wall's surface without noise in these windows, wall frame, m.
    sight : (3,) unit vector from the wall to the sensor, wall frame.
    """

    windows: Windows
    heights: FloatArray
    sight: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """(m,) names of the summary statistics of noise, as group.statistic, such as "size.nmad" or "variogram.8px"."""
        return (
            "size.std", "size.nmad", "size.quantiles",
            *(f"variogram.{lag}px" for lag in self.lags),
            *(f"deformation.{name}" for name, _ in self._modes[1:]), "deformation.rest",
            *("edges.std", "edges.nmad", "edges.std_elsewhere"),
            *("incidence.facing", "incidence.between", "incidence.oblique"),
        )  # fmt: skip

    def compute(self, maps: FloatArray) -> FloatArray:
        """Compute the summary statistics of e difference maps together: size, variogram and spatial pattern of the noise.

        Parameters
        ----------
        maps : (e, k, n, n) k windows of each map with n x n pixels, m; NaN where unknown.

        Returns
        -------
        (m,) natural logarithms of lengths in m, in the order of `names`.
        """
        middle = np.nanmedian(maps, axis=(2, 3))
        rest = maps - middle[..., None, None]
        lengths = [
            *self._size(rest),
            *self._variogram(rest),
            *self._deformation(middle),
            *self._edges(rest),
            *self._incidence(rest),
        ]
        return np.log(np.array(lengths) + _FLOOR_M)

    @cached_property
    def lags(self) -> tuple[int, ...]:
        """Distances at which the variogram of the noise is computed, pixels, up to three quarters of a window's side."""
        return tuple(lag for lag in _LAGS_PX if lag <= 0.75 * self.windows.side)

    def _size(self, rest: FloatArray) -> list[float]:
        """Return StD, NMAD and half the width of the central 95 %."""
        known = rest[~np.isnan(rest)]
        low, high = np.quantile(known, [0.025, 0.975])
        return [float(known.std()), _spread(known), float(high - low) / 2]

    def _variogram(self, rest: FloatArray) -> list[float]:
        """Return the root of the semivariance at each distance."""
        return [_root_semivariance(rest, lag) for lag in self.lags]

    def _deformation(self, middle: FloatArray) -> list[float]:
        """Return the RMS of each polynomial mode of the (e, k) medians, without the plane, and of the rest."""
        known = np.where(np.isnan(middle), np.nanmedian(middle, axis=1, keepdims=True), middle)
        found, left = [], known
        for _, basis in self._modes:
            part = known @ basis @ basis.T
            found.append(float(np.sqrt(np.mean(part**2))))
            left = left - part
        return [*found[1:], float(np.sqrt(np.mean(left**2)))]

    @cached_property
    def _modes(self) -> tuple[tuple[str, FloatArray], ...]:
        """Orthonormal polynomials of the windows' centres: for each degree its name and (k, j) columns.

        A degree is left out if there are fewer than two windows for each coefficient.
        """
        centre = self.windows.centres()
        x, y = ((centre - centre.mean(axis=0)) / np.maximum(np.ptp(centre, axis=0), 1e-9)).T
        degrees = ("plane", 0, 1), ("bend", 2, 2), ("twist", 3, 3)
        columns = [
            [x ** (degree - power) * y**power for degree in range(low, high + 1) for power in range(degree + 1)]
            for _, low, high in degrees
        ]
        total = np.cumsum([len(part) for part in columns])
        used = [place for place, terms in enumerate(total) if terms <= len(centre) / 2]
        if not used:
            return ()
        orthonormal, _ = np.linalg.qr(np.stack([column for place in used for column in columns[place]], axis=1))
        begin = [0, *total]
        return tuple((degrees[place][0], orthonormal[:, begin[place] : begin[place + 1]]) for place in used)

    def _edges(self, rest: FloatArray) -> list[float]:
        """Return StD and NMAD on steep ground, and StD elsewhere."""
        steep, other = rest[:, self._steep], rest[:, ~self._steep]
        steep, other = steep[~np.isnan(steep)], other[~np.isnan(other)]
        return [float(steep.std()), _spread(steep), float(other.std())]

    def _incidence(self, rest: FloatArray) -> list[float]:
        """Return the NMAD of each class of incidence angle."""
        values = (rest[:, self._incidence_class == number] for number in range(3))
        return [_spread(part[~np.isnan(part)]) for part in values]

    @cached_property
    def _gradient(self) -> tuple[FloatArray, FloatArray]:
        """dz/dx and dz/dy of the surface without noise, (k, n, n) each; 0 where unknown."""
        down, right = (np.gradient(self.heights, self.windows.grid.gsd, axis=axis) for axis in (1, 2))
        return np.nan_to_num(right), -np.nan_to_num(down)

    @cached_property
    def _steep(self) -> NDArray[np.bool_]:
        """(k, n, n) mask of the steepest tenth of the stable pixels."""
        slope = np.hypot(*self._gradient)
        return slope > np.quantile(slope[self.windows.stable], _STEEP)

    @cached_property
    def _incidence_class(self) -> NDArray[np.int8]:
        """(k, n, n) third by incidence angle, 0 the smallest angles; -1 where steep or not stable."""
        right, up = self._gradient
        cosine = (self.sight[2] - right * self.sight[0] - up * self.sight[1]) / np.sqrt(1 + right**2 + up**2)
        used = ~self._steep & self.windows.stable
        limits = np.quantile(cosine[used], [1 / 3, 2 / 3])
        return np.where(used, 2 - np.searchsorted(limits, cosine), -1).astype(np.int8)


def _spread(values: FloatArray) -> float:
    """Return the NMAD; 0 for too few values."""
    return nmad(values) if values.size >= _LEAST_IN_CLASS else 0.0


def _root_semivariance(rest: FloatArray, lag: int) -> float:
    """Return sqrt(gamma) at a distance of `lag` pixels along rows and columns."""
    total, count = 0.0, 0
    for difference in (rest[..., lag:, :] - rest[..., :-lag, :], rest[..., :, lag:] - rest[..., :, :-lag]):
        root = np.sqrt(np.abs(difference))
        total += float(np.nansum(root))
        count += int(np.count_nonzero(~np.isnan(root)))
    if count == 0:
        return 0.0
    return float(np.sqrt((total / count) ** 4 / (2 * (0.457 + 0.494 / count))))

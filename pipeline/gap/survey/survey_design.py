"""Combine the signatures of a survey's effects in one design matrix, with the pose of each station projected out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from pipeline.gap.mean.candidates import Candidate
from pipeline.gap.residuals.wall_blocks import WallCells
from pipeline.gap.survey.known_points import KnownPoints
from pipeline.gap.survey.survey_views import SurveyView
from scene.geometry.mesh import FloatArray

DETECTION_SNR = 5.0
"""Signal-to-noise ratio from which an effect counts as detectable."""
REFERENCE_LENGTH_M = 3.0
"""Correlation length of the reference's error, m."""
_NULL = 1e-9
"""Relative size below which what the pose leaves of a signature counts as nothing."""


def group_by_effect(candidates: list[Candidate]) -> dict[str, list[Candidate]]:
    """Group candidates by sensor effect, and keep the few of each that show which effects a survey can distinguish.

    An effect has a candidate (variant) for each choice of what is not fitted, such as the camera. The first variant represents
    the effect in tables. The others are kept because they may look like another effect. Of waves, only the one with the middle
    of the trial periods is kept.

    candidates: all variants of all effects (`SurveyView.signatures`). Returns those that are kept, by the effect's name.
    """
    groups: dict[str, list[Candidate]] = {}
    for candidate in candidates:
        groups.setdefault(candidate.name, []).append(candidate)
    families = {}
    for name, variants in groups.items():
        waves = [each for each in variants if each.wave is not None]
        if waves:
            first = [each for each in waves if each.fixed.get("camera") == waves[0].fixed.get("camera")]
            families[name] = [first[len(first) // 2]]
        elif "camera" in variants[0].fixed:
            least = min(len(each.names) for each in variants)
            single = [each for each in variants if len(each.names) == least]
            families[name] = [each for each in single if each.names == single[0].names]
        else:
            families[name] = [variants[0]]
    return families


def parameter_label(candidate: Candidate) -> str:
    """Return the name of an effect's main parameter for tables of detectable sizes, such as "amplitude_m".

    Several parameters of one kind are joined by commas. The phase and the period of a wave are left out.
    """
    hidden = {"phase_rad", "" if candidate.wave is None else candidate.wave.key}
    return ", ".join(name for name in candidate.names if name not in hidden)


def _scales(candidate: Candidate) -> tuple[float, ...]:
    """Value of the main parameter per unit of each coefficient."""
    units = np.eye(candidate.columns.shape[1])
    return tuple(
        max(abs(v) for key, v in candidate.parameters(unit).items() if key in parameter_label(candidate).split(", "))
        for unit in units
    )


@dataclass(frozen=True)
class SurveyDesign:
    """How m effects would change the n observations of a survey, to tell before fieldwork which it can detect and distinguish.

    A signature is such a change, divided by the standard deviations of the observations. An effect may have several variants,
    such as one for each camera, and a variant may have several fitted coefficients. Each of the k coefficients of all effects
    has a column.

    Attributes
    ----------
    projected : (n, k) signatures, less what a change of the stations' poses could explain.
    signatures : (n, k) whole signatures.
    pose_basis : (n, p) orthonormal basis of the changes of the observations by the p pose parameters.
    spans : For each effect, the slice of the k columns that belongs to each of its variants.
    scales : For each effect, the value of its main parameter per unit of each coefficient.
    cells : Squares of the wall. The error of the reference surface is modelled as one value for each square, correlated with
        those of other squares.
    sigma : (n,) standard deviations, m or px, reduced so that a subsample has the weight of all points.
    unit_m : Median metres of range or depth per unit of the observations (m or px).
    wall_rows : How many of the n observations are points on the wall; those of points with known positions follow.
    """

    projected: FloatArray
    signatures: FloatArray
    pose_basis: FloatArray
    spans: list[list[slice]]
    scales: list[tuple[float, ...]]
    cells: WallCells
    sigma: FloatArray
    unit_m: float
    wall_rows: int

    @classmethod
    def of(
        cls, views: tuple[SurveyView, ...], families: dict[str, list[Candidate]], points: KnownPoints | None = None
    ) -> SurveyDesign:
        """Compute how all effects would change the observations of a survey, with and without a fit of the stations' poses.

        Parameters
        ----------
        views : What each scanner station or stereo pair sees of the wall.
        families : The variants of each effect by its name, as `group_by_effect` gives them.
        points : Additional observations of points with known positions, such as targets; None if the survey has none.
        """
        wanted = [variant for variants in families.values() for variant in variants]
        columns = np.concatenate([view.signature_columns(wanted) for view in views])
        sigma = np.concatenate([view.sigma for view in views])
        stations = sorted({view.station for view in views})
        pose = np.concatenate(
            [np.kron(np.eye(len(stations))[stations.index(view.station)], view.residuals.pose_jacobian) for view in views]
        )
        wall = len(columns)
        if points is not None:
            more = np.zeros((len(points.sigma), pose.shape[1]))
            more[:, :6] = points.pose_jacobian
            columns, pose = np.concatenate([columns, points.columns(wanted)]), np.concatenate([pose, more])
            sigma = np.concatenate([sigma, points.sigma])
        whole, base = columns / sigma[:, None], np.linalg.qr(pose / sigma[:, None])[0]
        left = whole - base @ (base.T @ whole)
        stops = np.cumsum([variant.columns.shape[1] for variant in wanted]).tolist()
        slices = map(slice, [0, *stops[:-1]], stops)  # columns of each variant, in the order of `wanted`
        spans = [[next(slices) for _ in variants] for variants in families.values()]
        at = np.concatenate([view.residuals.wall_xy for view in views])
        unit = float(np.median(np.concatenate([view.residuals.unit_m for view in views])))
        scales = [_scales(variants[0]) for variants in families.values()]
        return cls(left, whole, base, spans, scales, WallCells.over(at), sigma, unit, wall)

    def survival(self) -> FloatArray:
        """Return the (m,) share of each effect's change of the observations that is left after a fit of the sensor's pose.

        It is between 0 and 1. Near 0, another pose explains the same change, and the effect stays hidden.
        """
        left, whole = ([np.linalg.norm(columns[:, v[0]]) for v in self.spans] for columns in (self.projected, self.signatures))
        return np.array(left) / np.maximum(whole, 1e-300)

    def cosines(self) -> FloatArray:
        """Return how similar the m effects look: (m, m) absolute cosines between their changes of the survey's observations.

        Near 1, the survey can hardly tell two effects apart. What another pose of the sensor could explain is left out. For
        effects with several variants, such as one for each camera, the first variant of either is compared with all of the
        other, and the largest value counts. Variants with several coefficients are compared by their largest canonical
        correlation.
        """
        bases = [[self._basis(span) for span in variants] for variants in self.spans]
        found = np.eye(len(bases))
        for a, b in permutations(range(len(bases)), 2):
            found[a, b] = min(1.0, max(float(np.linalg.norm(bases[a][0].T @ other, 2)) for other in bases[b]))
        return np.maximum(found, found.T)

    def _basis(self, span: slice) -> FloatArray:
        """Orthonormal basis of what the pose fit leaves of some columns; one column of zeros if nothing is left."""
        columns, whole = self.projected[:, span], np.linalg.norm(self.signatures[:, span], axis=0)
        kept = columns[:, np.linalg.norm(columns, axis=0) > _NULL * whole]
        return np.asarray(np.linalg.qr(kept)[0]) if kept.shape[1] else np.zeros((len(columns), 1))

    def detectable_size(self, reference_error_m: float) -> tuple[float, ...]:
        """Return the value of each effect's main parameter from which the survey detects it: a signal-to-noise ratio of 5.

        reference_error_m: standard deviation of the reference surface's error, which is correlated over metres, m; 0 for none.
        The values (m,) are infinite if another pose of the sensor explains the effect altogether.
        """
        first = [variants[0] for variants in self.spans]
        design = np.concatenate([self.pose_basis, *(self.projected[:, span] for span in first)], axis=1)
        information = self._information(design, reference_error_m / self.unit_m)
        count = stop = self.pose_basis.shape[1]
        nuisance = information[:count, :count]
        found = []
        for span, scales in zip(first, self.scales, strict=True):
            rows = range(stop, stop := stop + len(scales))
            cross = information[np.ix_(range(count), rows)]
            own = information[np.ix_(rows, rows)] - cross.T @ np.linalg.solve(nuisance, cross)
            least = float(np.linalg.eigvalsh(own / np.outer(scales, scales))[0])
            whole = float(np.max(np.sum((self.signatures[:, span] / np.array(scales)) ** 2, axis=0)))
            found.append(DETECTION_SNR / np.sqrt(least) if least > _NULL**2 * whole else np.inf)
        return tuple(found)

    def _information(self, design: FloatArray, error: float) -> FloatArray:
        """(k, k) information matrix of columns over sigma, if the cells' means share a correlated error of the reference."""
        wall, known = design[: self.wall_rows], design[self.wall_rows :]
        total = wall.T @ wall + known.T @ known
        if error <= 0:
            return np.asarray(total)
        inside = self.cells.cell >= 0
        cell, root = self.cells.cell[inside], 1 / self.sigma[: self.wall_rows][inside]
        weight = np.bincount(cell, root**2, len(self.cells))
        sums = np.stack([np.bincount(cell, root * column, len(self.cells)) for column in wall[inside].T], axis=1)
        reach = np.sqrt(3.0) * cdist(self.cells.centre, self.cells.centre) / REFERENCE_LENGTH_M
        kernel = error**2 * (1 + reach) * np.exp(-reach)
        means = sums / weight[:, None]
        taken = means.T @ sums  # what the means have in the white metric
        left = means.T @ cho_solve(cho_factor(kernel + np.diag(1 / weight)), means)
        return np.asarray(total - taken + left)

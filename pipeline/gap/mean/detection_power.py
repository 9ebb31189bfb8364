"""Compute the detectable size of each systematic effect: the size that would have shown with a probability of 95 %.

A signature S e with size t is added to the simulations of the null distribution: pose, correlated error of the reference and
noise. Under each covariance of the cells' means, with nuisance columns J and the projection P beside them, the log-likelihoods
without and with the candidate are

    L0(t) = L0(0) - t e'U - t² e'H e / 2        U = S'P y,  H = S'P S
    L1(t) = L0(t) + R'(H + K)^-1 R / 2          R = U + t H e,  K: prior precision of the sizes

Both are maximised over the covariances, because an effect that is left out makes the estimated error of the reference larger.
Twice their difference is noncentral chi-square with the noncentrality t² e'H e if the covariance is known; this gives the first
value of the search for t.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.stats import ncx2

from pipeline.gap.mean.candidates import Candidate, prior_precision
from pipeline.gap.mean.design import NULL_DRAWS, Design
from pipeline.gap.mean.nonparametric_terms import robust_extent
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

POWER = 0.95
"""Probability with which an effect of its detectable size would have been found."""
_SIZES = np.geomspace(0.7, 40.0, 48)
"""Sizes that are tried, relative to the one that the noncentral chi-square distribution gives."""
_ROUNDS = 2
"""Number of times that a size is computed, with the covariance that would be estimated beside an effect of that size."""
_NOTHING = 1e-9
"""Share of a signature's sum of squares below which nothing of it is left beside the nuisance parameters."""
_PHASE, _BOTH = "phase_rad", "both"


@dataclass(frozen=True)
class DetectableSize:
    """The size of an effect (a sensor error) that a measurement would have shown with a probability of 95 %.

    Attributes
    ----------
    name : Name of the effect; for an error that is not in the catalogue, what it depends on.
    parameter : Name of the effect's parameter that states the size; "" if the size is in the unit of the observable.
    size : Value of that parameter, in its unit; infinite if no size shows, NaN if it was not computed.
    at : Values that are not fitted and for which the size holds, by name, such as the period of a wave or the camera.
    note : Condition under which the size holds, or reason why there is none, in words; "" without any.
    """

    name: str
    parameter: str
    size: float
    at: Mapping[str, float | str] = field(default_factory=dict)
    note: str = ""

    def to_dict(self) -> dict[str, object]:
        """Return the detectable size of one effect as an entry of the list `detectable` in gap.json, one key per attribute.

        A size that is infinite or not computed becomes None.
        """
        size = self.size if np.isfinite(self.size) else None
        return {"name": self.name, "parameter": self.parameter, "size": size, "at": dict(self.at), "note": self.note}


def noncentrality(needed: float, columns: int) -> float:
    """Return how far an effect must stand out of the noise for a likelihood-ratio test to detect it with a probability of 95 %.

    Twice the log-likelihood ratio follows a noncentral chi-square distribution. Its noncentrality, which is returned, grows with
    the square of the effect's size, so that the detectable size follows from it.

    needed: log-likelihood ratio from which the test is passed. columns: number of design columns of the effect, the degrees of
    freedom.
    """
    at, rare = 2 * needed, 1e-9
    return float(brentq(lambda x: ncx2.sf(at, columns, x) - POWER, rare, 4 * (at + 10 * columns + 10)))


@dataclass(frozen=True, eq=False)
class DetectionPower:
    """Simulated measurements from which the detectable size of any examined sensor error follows.

    The simulations contain no errors but those already found. They are kept as inner products of d simulations with the k
    design columns of the examined errors, under each of C trial covariances of the reference surface's error. The columns of
    the pose and of the found errors are in every model; they are called nuisance columns.

    Attributes
    ----------
    likely : Index of the most likely covariance, under which the simulations were drawn.
    plain : (C, d) log-likelihood of each simulation with the nuisance columns alone fitted.
    right : (C, k, d) inner products of the examined columns with the simulations, nuisance columns projected out.
    matrix : (C, k, k) inner products of the examined columns with each other, nuisance columns projected out, plus the prior
        inverse variances on the diagonal.
    whole : (C, k) squared norms of the examined columns before the nuisance columns are projected out.
    """

    likely: int
    plain: FloatArray
    right: FloatArray
    matrix: FloatArray
    whole: FloatArray

    @classmethod
    def of(
        cls, design: Design, members: Sequence[Candidate], plain: list[int], sines: list[int], random: KeyedRandom
    ) -> DetectionPower:
        """Simulate measurements that contain no errors but those found, to compute from them the detectable sizes of others.

        Parameters
        ----------
        design : The regression problem with the found errors in the model (`Design.conditioned_on`).
        members : The found errors, fitted beside each examined error. Sines among them only determine the most likely
            covariance.
        plain : Numbers of the design columns to examine, of candidates that have known columns.
        sines : Numbers of the trial sines to examine, indices into `CandidateFamilies.sines`. In the result the examined columns
            are those of `plain`, then the sine and the cosine column of each trial sine.
        random : Source of the random numbers.
        """
        equations, known = design.equations, design.columns(members)
        likely = int(np.argmax(equations.log_likelihood(known)[:, 0]))
        draws = design.model.null_draws(equations.covariances[likely], NULL_DRAWS, random)
        base = [column for column in known if column < len(design.noise_products)]
        held = [equations.held_columns.index(column) for column in base]
        pairs = [2 * number + part for number in sines for part in (0, 1)]
        wanted, count = [*base, *plain], len(base)
        noise = np.concatenate([design.noise_products[wanted], design.sine_products.noise[pairs]])
        right, constant = [], []
        for each in equations.covariances:
            weighted = draws[each.basis] * each.weight[:, None]
            columns = np.concatenate(
                [design.fixed.between[each.basis][:, wanted], design.sine_products.between[each.basis][:, pairs]], axis=1
            )
            right.append(noise + columns.T @ weighted)
            constant.append(0.5 * (np.log(each.weight).sum() - np.sum(draws[each.basis] * weighted, axis=0)))
        drawn = np.stack(right)
        own = _block_diagonal(equations.fixed[:, plain][:, :, plain], equations.wave_own[:, sines])
        cross = np.concatenate([equations.fixed[:, plain][:, :, base], equations.wave_fixed[:, pairs][:, :, held]], axis=1)
        solved = equations.solved(base, np.concatenate([drawn[:, :count], cross.transpose(0, 2, 1)], axis=2))
        fitted, beside = np.split(solved, [NULL_DRAWS], axis=2)
        alone = np.stack(constant) + 0.5 * np.einsum("cbd,cbd->cd", drawn[:, :count], fitted)
        return cls(likely, alone, drawn[:, count:] - cross @ fitted, own - cross @ beside, np.einsum("ckk->ck", own))

    def size(self, candidate: Candidate, parameter: str, rows: list[int], needed_at: Callable[[Sequence[int]], float]) -> float:
        """Return the size of an error that the measurement would have shown with a probability of 95 %.

        It is in the unit of the parameter, and infinite if the error would not show at any size. An error of that size also
        raises the estimate of the reference surface's error, and with it the log-likelihood ratio that counts as detected. The
        size is therefore computed a second time, with that larger estimate.

        Parameters
        ----------
        candidate : The candidate error.
        parameter : The parameter whose size is wanted. If the error has a phase, the one that is hardest to detect is taken.
        rows : Numbers of the candidate's columns among the examined ones.
        needed_at : Function that returns the log-likelihood ratio that the error must reach to count as detected. Its argument is
            the indices of the trial covariances of the reference surface's error, the most likely first.
        """
        matrix, right = self.matrix[:, rows][:, :, rows], self.right[:, rows]
        information = matrix - np.diag(prior_precision(candidate, len(rows)))  # the normal equations contain the prior
        if _PHASE in candidate.names:
            along = np.asarray(np.linalg.eigh(information[self.likely])[1][:, 0])
        else:
            along = np.eye(len(rows))[candidate.names.index(parameter)]
        gained = information @ along
        squares = gained @ along
        if squares[self.likely] <= _NOTHING * float(along**2 @ self.whole[self.likely, rows]):
            return np.inf
        inverse = np.linalg.inv(matrix)
        slope = np.einsum("k,ckd->cd", along, right)

        def without(size: float) -> FloatArray:
            return self.plain - size * slope - 0.5 * size**2 * squares[:, None]

        def reached(size: float) -> float:
            left, moved = without(size), right + size * gained[:, :, None]
            explained = left + 0.5 * np.einsum("ckd,ckl,cld->cd", moved, inverse, moved)
            return float(np.quantile(explained.max(axis=0) - left.max(axis=0), 1 - POWER))

        size = 0.0
        for _ in range(_ROUNDS):
            needed = needed_at(np.argsort(-without(size).mean(axis=1), kind="stable").tolist())
            start = np.sqrt(noncentrality(needed, len(rows)) / squares[self.likely])
            size = _first_reaching(start * _SIZES, reached, needed)
            if not np.isfinite(size):
                break
        return size


def _first_reaching(sizes: FloatArray, reached: Callable[[float], float], needed: float) -> float:
    """Return the smallest size at which a rising function reaches `needed`, interpolated; infinite if no size does."""
    before = 0.0, 0.0
    for size in map(float, sizes):
        value = reached(size)
        if value >= needed:
            share = (needed - before[1]) / max(value - before[1], 1e-300) if before[0] else 1.0
            return before[0] + share * (size - before[0])
        before = size, value
    return float("inf")


def _block_diagonal(plain: FloatArray, sines: FloatArray) -> FloatArray:
    """(C, k, k) products of plain columns (C, p, p), then of pairs of columns of sines (C, w, 2, 2); those of two sines are 0."""
    count, start = plain.shape[1] + 2 * sines.shape[1], plain.shape[1]
    found = np.zeros((len(plain), count, count))
    found[:, :start, :start] = plain
    for number in range(sines.shape[1]):
        rows = slice(start + 2 * number, start + 2 * number + 2)
        found[:, rows, rows] = sines[:, number]
    return found


def detectable_sizes(
    design: Design,
    members: Sequence[Candidate],
    needed: Callable[[Candidate, Sequence[int]], float],
    random: KeyedRandom,
) -> list[DetectableSize]:
    """Compute how large each systematic sensor error must be to show, and how large smooth errors outside the catalogue.

    The smooth errors are waves with one cycle over the field of view. For an effect that either camera can have, the size of
    the camera in which it is harder to see is stated. An unknown period is set to the middle trial period.

    Parameters
    ----------
    design : The regression problem with the found errors in the model (`Design.conditioned_on`).
    members : The found errors; they are fitted beside each other error, and no size is computed for them.
    needed : Function that returns the log-likelihood ratio that a candidate error must reach to count as detected. Its
        arguments are the candidate, and the indices of the trial covariances of the reference surface's error, the most likely
        first.
    random : Source of the random numbers of the simulations.

    Returns
    -------
    One size for each parameter of each error.
    """
    names = {each.name for each in members if not each.empirical}
    plain = [each for each in design.families.plain if not each.empirical and each.name not in names and not _both(each)]
    numbers = [number for number in _examined_sines(design) if design.families.sines[number].name not in names]
    columns = [column for each in plain for column in design.column_numbers[each]]
    power = DetectionPower.of(design, members, columns, numbers, random)
    found: dict[tuple[str, str], list[DetectableSize]] = {}
    start = 0
    for each in [*plain, *(design.families.sines[number] for number in numbers)]:
        rows = list(range(start, start := start + (len(design.column_numbers[each]) if each.wave is None else 2)))
        name, at = (f"smooth error along {each.name}", {}) if each.empirical else (each.name, dict(each.fixed))
        for parameter in each.names[:1] if _PHASE in each.names else each.names:
            size = power.size(each, parameter, rows, partial(needed, each))
            key = name, "" if each.empirical else parameter
            found.setdefault(key, []).append(DetectableSize(*key, size, at))
    return [_of_variants(variants) for variants in found.values()]


def _both(candidate: Candidate) -> bool:
    """Whether a candidate changes both cameras alike, which a pair hardly sees."""
    return candidate.fixed.get("camera") == _BOTH


def _of_variants(variants: list[DetectableSize]) -> DetectableSize:
    """Return the detectable size of an effect with variants: the smallest of each camera's, and of these the largest."""
    cameras: dict[object, DetectableSize] = {}
    for each in variants:
        side = each.at.get("camera")
        if side not in cameras or each.size < cameras[side].size:
            cameras[side] = each
    return max(cameras.values(), key=lambda each: each.size)


def _examined_sines(design: Design) -> list[int]:
    """Numbers of the sines to examine: the middle period of each effect, and one cycle along each covariate of the position."""
    found: dict[tuple[str, object], int] = {}
    start = 0
    for grid in design.families.grids:
        count = len(grid.frequencies)
        if not grid.empirical:
            found.setdefault((grid.name, grid.fixed.get("camera")), start + count // 2)
        elif grid.name in design.residuals.position_covariates and not grid.angle:
            once = 1 / robust_extent(grid.wave.x)
            found.setdefault((grid.name, ""), start + int(np.argmin(np.abs(grid.frequencies - once))))
        start += count
    return list(found.values())

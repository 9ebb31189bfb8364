"""Divide design columns into their parts within and between the cells of the wall, in the form in which the fits use them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class ProjectedColumns:
    """k design columns (or residuals) at n points, divided into their parts within and between the m cells of the wall.

    The wall is divided into at most about 800 square cells, each with several points. The part between cells is the mean of a
    column in each cell; the part within cells is the deviation from the mean, or from a plane. The error of the reference
    surface varies little within a cell, so only the part between cells depends on its covariance. Columns are divided by the
    standard deviation of each point.

    Attributes
    ----------
    within : (n, k) deviations within cells.
    within_weighted : (n, k) deviations times the inverse covariance of their noise, so that a.within.T @ b.within_weighted are
        the inner products of two sets of columns.
    between : For each trial correlation function of the reference's error, the (m, k) cell means in coordinates of its
        eigenvectors.
    """

    within: FloatArray
    within_weighted: FloatArray
    between: list[FloatArray]

    @classmethod
    def concatenate(cls, parts: Sequence[ProjectedColumns]) -> ProjectedColumns:
        """Join several sets of design columns for the same n points to one, in the given order.

        parts: the sets, such as the columns of the pose and those of each candidate error; at least one.
        """
        if len(parts) == 1:
            return parts[0]
        within = np.concatenate([each.within for each in parts], axis=1)
        white = all(each.within_weighted is each.within for each in parts)
        weighed = within if white else np.concatenate([each.within_weighted for each in parts], axis=1)
        bases = zip(*(each.between for each in parts), strict=True)
        return cls(within, weighed, [np.concatenate(basis, axis=1) for basis in bases])

    def select(self, columns: list[int]) -> ProjectedColumns:
        """Return some of the k design columns, such as those of one candidate error.

        columns: their numbers, from 0, in the wanted order.
        """
        within = self.within[:, columns]
        weighed = within if self.within_weighted is self.within else self.within_weighted[:, columns]
        return ProjectedColumns(within, weighed, [part[:, columns] for part in self.between])

    def in_bases(self, bases: list[int]) -> ProjectedColumns:
        """Return the same design columns for only some trial correlation functions of the reference error, which saves time.

        bases: indices of these functions in the list `between`; `MeanModel.restrict` drops the unlikely ones.
        """
        return ProjectedColumns(self.within, self.within_weighted, [self.between[basis] for basis in bases])


@dataclass(frozen=True)
class WithinProducts:
    """Inner products of k design columns with each other and with v columns of residuals, of their parts within cells.

    They are what normal equations under all covariances of the reference surface's error have in common.

    Attributes
    ----------
    gram : (k, k) products of the design columns with each other.
    right : (k, v) products of the design columns with the residuals.
    square : (v,) products of each column of residuals with itself.
    """

    gram: FloatArray
    right: FloatArray
    square: FloatArray

    @classmethod
    def of(cls, columns: ProjectedColumns, value: ProjectedColumns) -> WithinProducts:
        """Compute the products of design columns and residuals at the same n points."""
        y = value.within_weighted
        return cls(columns.within.T @ columns.within_weighted, columns.within.T @ y, np.einsum("nv,nv->v", value.within, y))

    def first(self, count: int) -> WithinProducts:
        """Return the products of the first design columns alone, such as those of the pose. count: how many."""
        return WithinProducts(self.gram[:count, :count], self.right[:count], self.square)

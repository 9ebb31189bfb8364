"""Define the components of a procedural rock wall: smooth noise, bedded and jointed blocks, erosional notches.

Each component is a function of the position (u along the wall, v up its slope, m), drawn on lattices of fixed size, so that
every sampling gives the same rock. Components return float32 arrays. Positions are regular axes, or arrays that other
components have bent.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

Field = NDArray[np.float32]
Size = tuple[float, float]
"""Width and height of the wall plane, m."""

_MARGIN_M = 6.0
"""How far the tables of blocks extend beyond the wall, so that bent coordinates stay inside them."""
_TABLE_STEP_M = 0.01
"""Sampling of tables of one coordinate."""
_NOTCH_STEP_M = 0.05
"""Spacing of the lattice of notches."""
_RAMP_PER_STEP = 0.25
"""Width of a step between blocks relative to its height: steep but never vertical."""


@dataclass(frozen=True)
class SplineNoise:
    """Smooth random field over the wall plane, with unit standard deviation, for relief and albedo of generated rock.

    It is a uniform cubic B-spline over a lattice of independent normal numbers.

    Attributes
    ----------
    lattice : (rows, columns) float32 array
        Control values; row k lies at height v = (k - 1) step_v_m up the slope.
    step_u_m, step_v_m : float
        Spacing of the lattice along the wall and up its slope, m.
    """

    lattice: Field
    step_u_m: float
    step_v_m: float

    @classmethod
    def make(cls, random: KeyedRandom, size: Size, step_u_m: float, step_v_m: float | None = None) -> SplineNoise:
        """Draw the lattice of random numbers for a smooth random field over a wall plane.

        Parameters
        ----------
        random : KeyedRandom
            Source of random numbers.
        size : (float, float)
            Width and height of the wall plane, m.
        step_u_m, step_v_m : float
            Spacing of the lattice along the wall and up its slope, m; the second equals the first by default.
        """
        step_v_m = step_u_m if step_v_m is None else step_v_m
        shape = int(size[1] / step_v_m) + 5, int(size[0] / step_u_m) + 5
        deviation = 0.4795  # of the spline between its knots: the mean square over a cell is (151/315)^2
        return cls(random.generator().standard_normal(shape, dtype=np.float32) / deviation, step_u_m, step_v_m)

    def at(self, u: FloatArray, v: FloatArray) -> Field:
        """Evaluate the random field on a regular grid, (len(v), len(u)).

        u, v: coordinates of the grid's columns, along the wall, and of its rows, up the slope, m.
        """
        column, weight_u = _spline_weights(u, self.step_u_m)
        row, weight_v = _spline_weights(v, self.step_v_m)
        lattice = self.lattice[row[0] : row[-1] + 4]
        along = sum(lattice[:, column + k] * weight_u[k] for k in range(4))
        return sum(along[row - row[0] + k] * weight_v[k][:, None] for k in range(4))


def _spline_weights(x: FloatArray, step: float) -> tuple[NDArray[np.intp], Field]:
    """Return the first lattice index (n,) and the four cubic B-spline weights (4, n) for each position."""
    cell = np.floor(x / step)
    f = x / step - cell
    weights = np.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3]) / 6
    return cell.astype(np.intp), weights.astype(np.float32)


@dataclass(frozen=True)
class Fractal:
    """Self-affine random roughness of rock: a sum of smooth random fields (octaves), the finer ones with smaller amplitudes.

    The amplitude of an octave is amplitude (step / 1 m)^hurst, with the spacing `step` of its lattice. `octaves` holds
    amplitude and field of each.
    """

    octaves: tuple[tuple[float, SplineNoise], ...]

    @classmethod
    def make(
        cls, random: KeyedRandom, size: Size, amplitude: float, hurst: float, steps_m: tuple[float, float], aspect: float
    ) -> Fractal:
        """Draw the octaves (random fields of decreasing grain size) of a self-affine roughness.

        Parameters
        ----------
        random : KeyedRandom
            Source of random numbers.
        size : (float, float)
            Width and height of the wall plane, m.
        amplitude : float
            Amplitude at a scale of 1 m, in m for a relief.
        hurst : float
            Hurst exponent.
        steps_m : (float, float)
            Coarsest and finest lattice spacing, m; each octave halves it.
        aspect : float
            Ratio of the grain's length up the wall to that along it.
        """
        coarsest, finest = steps_m
        steps = [coarsest / 2**k for k in range(round(np.log2(coarsest / finest)) + 1)]
        noises = (SplineNoise.make(random.child(k), size, step, step * aspect) for k, step in enumerate(steps))
        return cls(tuple((amplitude * step**hurst, noise) for step, noise in zip(steps, noises, strict=True)))

    def at(self, u: FloatArray, v: FloatArray) -> Field:
        """Evaluate the roughness, the sum of all octaves, on a regular grid, (len(v), len(u)).

        u, v: coordinates of the grid's columns, along the wall, and of its rows, up the slope, m.
        """
        total = np.zeros((len(v), len(u)), np.float32)
        for amplitude, noise in self.octaves:
            total += np.float32(amplitude) * noise.at(u, v)
        return total


@dataclass(frozen=True)
class Table:
    """A function of one coordinate, such as the relief of beds as a function of height.

    It has samples (`values`) every centimetre from `start` (m), is linear between them and constant beyond its ends.
    """

    start: float
    values: Field

    @classmethod
    def through(cls, knots: FloatArray, values: FloatArray) -> Table:
        """Make the piecewise linear function through points, given by positions and values of equal shape (n,).

        knots: positions, m, ascending. values: the function's values there.
        """
        x = np.arange(knots[0], knots[-1] + _TABLE_STEP_M, _TABLE_STEP_M)
        return cls(float(knots[0]), np.interp(x, knots, values).astype(np.float32))

    def at(self, x: Field) -> Field:
        """Evaluate the function at positions x, m, of any shape."""
        column = (x - np.float32(self.start)) / np.float32(_TABLE_STEP_M)
        return _look_up(self.values[None], column, np.zeros_like(column))


@dataclass(frozen=True)
class BlockRule:
    """How one generation of beds and joints divides the rock into blocks, and how far the blocks protrude.

    A block lies between two beds and two joints. Beds are spaced along s = v - dip u, joints along t = u - lean v, with u along
    the wall and v up its slope, m.

    Attributes
    ----------
    bed_m, joint_m : float
        Mean spacing of beds and joints, m.
    offset_m : float
        Scale of the blocks' offsets, m. They are heavy-tailed: most blocks stay near the plane, few protrude or are missing.
    tilt : float
        Standard deviation of the slope (1) of a block's face against the wall plane.
    dip : float
        Slope of the beds along the wall.
    lean : float
        Slope of the joints from the line of greatest slope.
    ramp_m : float
        Width over which a step between beds rises, m.
    spread : float
        Standard deviation of the logarithm of the spacings.
    """

    bed_m: float
    joint_m: float
    offset_m: float
    tilt: float = 0.03
    dip: float = 0.0
    lean: float = 0.0
    ramp_m: float = 0.05
    spread: float = 0.45


@dataclass(frozen=True)
class JointedBlocks:
    """Blocks into which beds and joints divide a generated wall: how far each protrudes, and how bright it is.

    They are stored as tables with a row for each bed and a column for each centimetre along the beds. The coordinates, m, follow
    the rock: s = v - dip u crosses the beds, and t = u - lean v runs along them and crosses the joints. Here u is along the wall,
    v is up its slope, and `dip` and `lean` are the slopes in the rule.

    Attributes
    ----------
    rule : BlockRule
        Spacing and slopes of beds and joints, and how far blocks protrude.
    row : Table
        Table row as a function of s: a whole number within a bed, rising to the next over `ramp_m` of the rule, so that
        bilinear interpolation of the tables makes the steps between beds.
    across : Table
        Distance of s from the middle of its bed as a function of s, m.
    start : float
        t of the first column, m.
    height, slope, tone : float32 arrays (beds, columns)
        Height of the block's face over the wall plane (m), its slope across the bed (1), and its tone: a standard normal number
        for each block, which makes its albedo higher or lower.
    """

    rule: BlockRule
    row: Table
    across: Table
    start: float
    height: Field
    slope: Field
    tone: Field

    @classmethod
    def make(cls, random: KeyedRandom, size: Size, rule: BlockRule) -> JointedBlocks:
        """Draw the blocks between beds and joints at random.

        size: width and height of the wall plane, m. rule: how beds and joints divide the rock.
        """
        draw = random.generator()
        reach_s, reach_t = _MARGIN_M + abs(rule.dip) * size[0], _MARGIN_M + abs(rule.lean) * size[1]
        beds = draw_partings(draw, -reach_s, size[1] + reach_s, rule.bed_m, rule.spread)
        t = np.arange(-reach_t, size[0] + reach_t, _TABLE_STEP_M)
        height, slope, tone = np.stack([_bed_profile(draw, t, thickness, rule) for thickness in np.diff(beds)], axis=1)
        knots = ramp_knots(beds[1:-1], rule.ramp_m)
        row, middle = np.arange(len(beds) - 1.0), (beds[1:] + beds[:-1]) / 2
        row_table = Table.through(knots, np.repeat(row, 2)[1:-1])
        middles = np.repeat(middle, 2)[1:-1]
        return cls(rule, row_table, Table.through(knots, knots - middles), float(t[0]), height, slope, tone)

    def at(self, u: Field, v: Field) -> tuple[Field, Field]:
        """Return the relief of the blocks' faces, m, and the tone of the blocks at positions in the wall plane.

        u, v: (any shape) positions along the wall and up its slope, m, already shifted by how far beds and joints depart from
        straight lines there. The tone is a standard normal number for each block, which makes its albedo higher or lower.
        """
        s = v - np.float32(self.rule.dip) * u
        t = u - np.float32(self.rule.lean) * v
        column = (t - np.float32(self.start)) / np.float32(_TABLE_STEP_M)
        row = self.row.at(s)
        height = _look_up(self.height, column, row)
        height += self.across.at(s) * _look_up(self.slope, column, row)
        return height, _look_up(self.tone, column, row)


@dataclass(frozen=True)
class Notches:
    """Erosional notches of a generated wall, concave forms with a steep roof above and a longer floor below.

    `depth` holds their depths (m, positive into the rock) on a lattice with a spacing of 5 cm over the wall plane.
    """

    depth: Field

    @classmethod
    def make(cls, random: KeyedRandom, size: Size, per_m2: float, median_m: float) -> Notches:
        """Draw erosional notches at random.

        Parameters
        ----------
        random : KeyedRandom
            Source of random numbers.
        size : (float, float)
            Width and height of the wall plane, m.
        per_m2 : float
            Number of notches per m2.
        median_m : float
            Their median size, m.
        """
        draw = random.generator()
        u, v = (np.arange(0.0, extent + _NOTCH_STEP_M, _NOTCH_STEP_M) for extent in size)
        depth = np.zeros((len(v), len(u)), np.float32)
        for _ in range(round(per_m2 * size[0] * size[1])):
            centre_u, centre_v = draw.uniform(0, size)
            half = median_m / 2 * np.exp(0.5 * draw.standard_normal())
            stretch = np.exp(0.4 * draw.standard_normal())
            columns = slice(*np.searchsorted(u, centre_u + half * stretch * np.array([-1, 1])))
            rows = slice(*np.searchsorted(v, centre_v + half * np.array([-1, 0.5])))
            q_v = (v[rows] - centre_v) / np.where(v[rows] > centre_v, 0.5 * half, half)
            q = ((u[columns] - centre_u) / (half * stretch)) ** 2 + q_v[:, None] ** 2
            bowl = 0.35 * half * np.sqrt(np.maximum(1 - q, 0))
            depth[rows, columns] = np.maximum(depth[rows, columns], bowl)
        return cls(depth)

    def at(self, u: Field, v: Field) -> Field:
        """Return the depth of the notches, m, at positions in the wall plane.

        u, v: (any shape) positions along the wall and up its slope, m, already shifted by how far beds and joints depart from
        straight lines there.
        """
        return _look_up(self.depth, u / np.float32(_NOTCH_STEP_M), v / np.float32(_NOTCH_STEP_M))


def draw_partings(draw: np.random.Generator, start: float, stop: float, mean: float, spread: float) -> FloatArray:
    """Draw the positions of beds or joints of a generated wall: ascending, with lognormal spacings.

    Parameters
    ----------
    draw : np.random.Generator
        Source of random numbers.
    start, stop : float
        Range that the positions cover, m.
    mean : float
        Mean spacing, m.
    spread : float
        Standard deviation of the logarithm of the spacings.
    """
    count = int(2 * (stop - start) / mean) + 8
    spacing = mean * np.exp(spread * draw.standard_normal(count) - spread**2 / 2)
    edges = start - mean * draw.uniform() + np.concatenate([[0.0], np.cumsum(spacing)])
    return edges[: np.searchsorted(edges, stop) + 2]


def ramp_knots(edges: FloatArray, ramp: float | FloatArray) -> FloatArray:
    """Return where the steps of the relief at beds or joints begin and end to rise: (2 n,) positions, m, two for each of n steps.

    edges: (n,) positions of the steps (beds or joints), m, ascending. ramp: width over which a step rises, m, one number or (n,);
    it is less where edges are close together.
    """
    half = np.broadcast_to(np.asarray(ramp) / 2, edges.shape).copy()
    gap = np.diff(edges)
    half[1:] = np.minimum(half[1:], 0.4 * gap)
    half[:-1] = np.minimum(half[:-1], 0.4 * gap)
    return np.stack([edges - half, edges + half], axis=1).ravel()


def _bed_profile(draw: np.random.Generator, t: FloatArray, thickness: float, rule: BlockRule) -> Field:
    """Draw the blocks of one bed along t: height, slope and tone (3, n).

    The tilt lifts no block's edge by more than the scale of offsets.
    """
    joints = draw_partings(draw, t[0], t[-1], rule.joint_m, rule.spread)
    offset, tilt, slope, tone = draw.standard_normal((4, len(joints) - 1))
    offset = rule.offset_m * np.clip(offset * np.abs(offset), -3, 3)
    lift = np.clip(rule.tilt * tilt * np.diff(joints) / 2, -rule.offset_m, rule.offset_m)
    steepest = min(rule.tilt, 2 * rule.offset_m / thickness)
    face = np.stack([offset - lift, offset + lift], axis=1)
    ramp = np.clip(_RAMP_PER_STEP * np.abs(face[1:, 0] - face[:-1, 1]), 0.01, 0.12)
    knots = ramp_knots(joints[1:-1], ramp)
    ends = face.ravel()[1:-1], np.repeat(steepest * slope, 2)[1:-1], np.repeat(tone, 2)[1:-1]
    return np.stack([np.interp(t, knots, values) for values in ends]).astype(np.float32)


def _look_up(table: Field, column: Field, row: Field) -> Field:
    """Interpolate a table bilinearly at fractional columns and rows; positions beyond it get its edge values."""
    return cv2.remap(table, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

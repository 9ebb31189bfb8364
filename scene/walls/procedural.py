"""Make procedural rock walls in the style of the four monitored sites."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field as Key

from scene.common.config import Config
from scene.common.keyed_random import KeyedRandom
from scene.common.plug_ins import load_plug_ins
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh
from scene.walls.rock import (
    BlockRule,
    Field,
    Fractal,
    JointedBlocks,
    Notches,
    Size,
    SplineNoise,
    Table,
    draw_partings,
    ramp_knots,
)

_ROWS_AT_ONCE = 64
"""Number of rows of vertices evaluated at a time."""
_DETREND_STEP_M = 0.5
"""Spacing of the points through which the mean plane of the relief is fitted."""
_FAULT_LEAN = 0.12
"""Slope of the faults from the line of greatest slope."""


@dataclass(frozen=True)
class Band:
    """A seam of another rock in the wall.

    Attributes
    ----------
    at : float
        Height of the seam's lower edge, as a share (0 to 1) of the wall's height.
    thickness_m : float
        Thickness along the slope, m.
    recess_m : float
        How far the seam lies behind the rest of the wall, m.
    blocks : tuple of BlockRule
        How beds and joints divide its rock into blocks.
    roughness : float
        Factor on the roughness of the rest of the wall.
    albedo : float
        Mean albedo.
    """

    at: float
    thickness_m: float
    recess_m: float
    blocks: tuple[BlockRule, ...]
    roughness: float
    albedo: float


@dataclass(frozen=True)
class Site:
    """The parameters of the rock of one real site, in whose style walls are generated.

    Attributes
    ----------
    width_m, height_m : float
        Size of the wall plane, along the wall and up its slope, m.
    slope_rad : float
        Inclination of the mean plane from the horizontal, rad.
    blocks : tuple of BlockRule
        How beds and joints divide the rock into blocks, coarsest first.
    undulation_m : float
        Amplitude of forms of 4 m and more, m.
    bend_m : float
        How far beds and joints depart from straight lines, m.
    ledge_bed_m, ledge_m, bed_dip : float
        Spacing of alternating hard and soft beds (m), how far hard ones protrude (m), and their slope along the wall (1).
    fault_m, throw_m : float
        Spacing of the faults, and how far they offset the beds, m.
    roughness, hurst : float
        Amplitude of the fractal relief at a scale of 1 m (m), and its Hurst exponent (1).
    albedo, bed_tone, block_tone, streaks : float
        Mean albedo (0 to 1), and about the standard deviation by which it varies between beds, between blocks and by water
        streaks.
    notches_per_m2, notch_m : float
        Number of erosional notches per m2, and their median size (m).
    band : Band, optional
        A seam of another rock.
    """

    width_m: float
    height_m: float
    slope_rad: float
    blocks: tuple[BlockRule, ...]
    undulation_m: float
    bend_m: float
    ledge_bed_m: float
    ledge_m: float
    bed_dip: float
    fault_m: float
    throw_m: float
    roughness: float
    hurst: float
    albedo: float
    bed_tone: float
    block_tone: float
    streaks: float
    notches_per_m2: float = 0.0
    notch_m: float = 2.0
    band: Band | None = None


OWN_SITES = {
    "glendale": Site(
        width_m=70.0,
        height_m=45.0,
        slope_rad=np.radians(70.0),
        blocks=(
            BlockRule(bed_m=13.0, joint_m=4.0, offset_m=0.3, tilt=0.05, dip=0.01, lean=0.06, ramp_m=0.2, spread=0.7),
            BlockRule(bed_m=3.5, joint_m=1.2, offset_m=0.16, tilt=0.10, dip=0.03, lean=-0.07, spread=0.7),
            BlockRule(bed_m=1.8, joint_m=3.0, offset_m=0.10, tilt=0.10, dip=-0.25, lean=0.35, ramp_m=0.06, spread=0.8),
            BlockRule(bed_m=0.8, joint_m=0.4, offset_m=0.025, tilt=0.08, dip=0.02, lean=0.1, ramp_m=0.03, spread=0.8),
        ),
        undulation_m=0.10,
        bend_m=0.6,
        ledge_bed_m=4.0,
        ledge_m=0.12,
        bed_dip=0.015,
        fault_m=25.0,
        throw_m=0.3,
        roughness=0.04,
        hurst=0.8,
        albedo=0.48,
        bed_tone=0.04,
        block_tone=0.018,
        streaks=0.025,
        band=Band(
            at=0.45,
            thickness_m=2.3,
            recess_m=0.5,
            blocks=(
                BlockRule(bed_m=0.45, joint_m=0.8, offset_m=0.10, tilt=0.2, ramp_m=0.05),
                BlockRule(bed_m=0.10, joint_m=0.16, offset_m=0.05, tilt=0.3, lean=0.2, ramp_m=0.03),
            ),
            roughness=2.5,
            albedo=0.12,
        ),
    ),
    "bulga": Site(
        width_m=70.0,
        height_m=45.0,
        slope_rad=np.radians(75.0),
        blocks=(
            BlockRule(bed_m=45.0, joint_m=7.0, offset_m=0.22, tilt=0.025, lean=0.04, ramp_m=0.2, spread=0.8),
            BlockRule(bed_m=1.6, joint_m=3.5, offset_m=0.13, tilt=0.06, lean=0.03, spread=0.8),
            BlockRule(bed_m=0.6, joint_m=1.1, offset_m=0.06, tilt=0.06, lean=-0.05, ramp_m=0.04, spread=0.8),
            BlockRule(bed_m=0.18, joint_m=0.7, offset_m=0.015, tilt=0.06, ramp_m=0.03, spread=0.7),
        ),
        undulation_m=0.08,
        bend_m=0.35,
        ledge_bed_m=1.1,
        ledge_m=0.28,
        bed_dip=0.01,
        fault_m=30.0,
        throw_m=0.25,
        roughness=0.025,
        hurst=0.75,
        albedo=0.5,
        bed_tone=0.11,
        block_tone=0.02,
        streaks=0.03,
    ),
    "bismantova": Site(
        width_m=70.0,
        height_m=70.0,
        slope_rad=np.radians(84.0),
        blocks=(
            BlockRule(bed_m=35.0, joint_m=6.0, offset_m=0.6, tilt=0.06, lean=0.04, ramp_m=0.25, spread=0.7),
            BlockRule(bed_m=14.0, joint_m=1.8, offset_m=0.2, tilt=0.08, dip=0.05, lean=-0.05, ramp_m=0.10, spread=0.8),
            BlockRule(bed_m=3.0, joint_m=0.6, offset_m=0.04, tilt=0.08, dip=-0.1, lean=0.03, spread=0.8),
        ),
        undulation_m=0.16,
        bend_m=0.9,
        ledge_bed_m=6.0,
        ledge_m=0.10,
        bed_dip=0.08,
        fault_m=40.0,
        throw_m=0.2,
        roughness=0.045,
        hurst=0.8,
        albedo=0.55,
        bed_tone=0.03,
        block_tone=0.02,
        streaks=0.11,
        notches_per_m2=0.03,
        notch_m=2.6,
    ),
    "pilkington": Site(
        width_m=15.0,
        height_m=8.0,
        slope_rad=np.radians(78.0),
        blocks=(
            BlockRule(bed_m=3.5, joint_m=1.8, offset_m=0.15, tilt=0.10, dip=0.04, lean=0.10, ramp_m=0.06, spread=0.7),
            BlockRule(bed_m=0.6, joint_m=0.8, offset_m=0.09, tilt=0.10, dip=0.04, lean=-0.08, ramp_m=0.04, spread=0.7),
            BlockRule(bed_m=1.2, joint_m=0.7, offset_m=0.04, tilt=0.10, dip=-0.15, lean=0.30, ramp_m=0.03, spread=0.8),
            BlockRule(bed_m=0.12, joint_m=0.4, offset_m=0.010, tilt=0.06, dip=0.04, ramp_m=0.02, spread=0.7),
        ),
        undulation_m=0.04,
        bend_m=0.35,
        ledge_bed_m=0.45,
        ledge_m=0.10,
        bed_dip=0.04,
        fault_m=3.5,
        throw_m=0.35,
        roughness=0.028,
        hurst=0.75,
        albedo=0.48,
        bed_tone=0.09,
        block_tone=0.03,
        streaks=0.03,
    ),
}

PLUG_INS = "scarpsim.wall_styles"
"""Group of entry points by which other packages add styles, each a `Site`."""
SITES = OWN_SITES | load_plug_ins(PLUG_INS, "a scene.walls.procedural.Site", lambda value: isinstance(value, Site), OWN_SITES)
"""All styles by name."""
if TYPE_CHECKING:
    Style = str
else:
    Style = Literal[tuple(SITES)]


class ProceduralWall(Config):
    """A wall generated by rules: the same style and seed give the same rock at every resolution."""

    style: Style = Key("glendale", description="the site whose rock it resembles")
    width_m: float | None = Key(None, ge=0.5, le=200.0, description="width along the wall, m; the site's own by default")
    height_m: float | None = Key(None, ge=0.5, le=200.0, description="height measured up the slope, m; the site's own by default")
    resolution_m: float = Key(0.05, ge=0.005, le=1.0, description="distance between vertices in the wall plane, m")
    slope_rad: float | None = Key(
        None, ge=0.2, le=1.6, description="inclination of the mean plane from the horizontal, rad; the site's own by default"
    )
    seed: int | None = Key(None, ge=0, description="seed of the wall alone; the run's seed by default")

    @property
    def site(self) -> Site:
        """The parameters of the site's rock that the configured style stands for."""
        return SITES[self.style]

    @property
    def size(self) -> Size:
        """Width along the wall and height up its slope, m: the configured ones, or else those of the site."""
        return self.width_m or self.site.width_m, self.height_m or self.site.height_m

    def mesh(self, random: KeyedRandom) -> TriangleMesh:
        """Generate the wall as a triangle mesh in the world frame, m.

        x runs along the wall, z is up and y points into the slope. The toe is near y = z = 0; sensors stand at negative y.
        `random` is the source of random numbers.
        """
        source = random if self.seed is None else KeyedRandom(self.seed)
        rock = Rock.make(source.child("wall", self.style), self.size, self.site)
        count_u, count_v = (max(round(extent / self.resolution_m), 1) + 1 for extent in self.size)
        u, v = np.linspace(0.0, self.size[0], count_u), np.linspace(0.0, self.size[1], count_v)
        relief, albedo = rock.surface(u, v)
        slope = self.site.slope_rad if self.slope_rad is None else self.slope_rad
        vertices = np.empty((count_v, count_u, 3))
        vertices[..., 0] = u
        vertices[..., 1] = np.cos(slope) * v[:, None] - np.sin(slope) * relief
        vertices[..., 2] = np.sin(slope) * v[:, None] + np.cos(slope) * relief
        return TriangleMesh(vertices.reshape(-1, 3), _grid_faces(count_v, count_u), albedo.ravel())


@dataclass(frozen=True)
class Rock:
    """Relief (m, out of the wall plane) and albedo of one generated wall as functions of the position in its plane.

    The position is u along the wall and v up its slope, m.

    Attributes
    ----------
    site, size
        Parameters of the site's rock, and width and height of the wall plane, m.
    undulation, roughness : Fractal
        Relief of coarse forms and of the surface, m.
    bend_u, bend_v : Fractal
        How far beds and joints depart from straight lines, m.
    fault, ledge, bed_tone : Table
        Offset of the beds by faults (m), relief of hard and soft beds (m), and how far the beds' albedo differs from the mean.
    blocks, band_blocks : tuple of JointedBlocks
        Blocks between beds and joints, of the wall and of its seam of another rock.
    notches : Notches, optional
        Erosional notches.
    patches, streaks, grain
        Patches of more and of less broken rock, and the variation of the albedo by water streaks and from point to point.
    """

    site: Site
    size: Size
    undulation: Fractal
    bend_u: Fractal
    bend_v: Fractal
    fault: Table
    ledge: Table
    bed_tone: Table
    blocks: tuple[JointedBlocks, ...]
    notches: Notches | None
    roughness: Fractal
    patches: SplineNoise
    streaks: Fractal
    grain: Fractal
    band_blocks: tuple[JointedBlocks, ...]

    @classmethod
    def make(cls, random: KeyedRandom, size: Size, site: Site) -> Rock:
        """Draw all parts of a wall's rock at random, in the style of a site.

        size: width and height of the wall plane, m. site: the parameters of the site's rock.
        """

        def fractal(name: str, amplitude: float, hurst: float, steps_m: tuple[float, float], aspect: float = 1.0) -> Fractal:
            return Fractal.make(random.child(name), size, amplitude, hurst, steps_m, aspect)

        def blocks(name: str, rules: tuple[BlockRule, ...]) -> tuple[JointedBlocks, ...]:
            return tuple(JointedBlocks.make(random.child(name, k), size, rule) for k, rule in enumerate(rules))

        bend = site.bend_m / 8.0**0.9
        ledge, tone = _beds(random.child("beds"), size, site)
        notches = Notches.make(random.child("notches"), size, site.notches_per_m2, site.notch_m) if site.notches_per_m2 else None
        return cls(
            site,
            size,
            fractal("undulation", site.undulation_m / 16.0, 1.0, (16.0, 4.0)),
            fractal("bend_u", bend, 0.9, (8.0, 0.125)),
            fractal("bend_v", bend / 2, 0.9, (8.0, 0.125)),
            _faults(random.child("faults"), size, site),
            ledge,
            tone,
            blocks("blocks", site.blocks),
            notches,
            fractal("roughness", site.roughness, site.hurst, (2.0, 0.03125)),
            SplineNoise.make(random.child("patches"), size, 3.0),
            fractal("streaks", 1.0, 0.5, (1.0, 0.25), aspect=8.0),
            fractal("grain", 0.035, 0.15, (0.5, 0.03125)),
            blocks("band", site.band.blocks if site.band else ()),
        )

    def surface(self, u: FloatArray, v: FloatArray) -> tuple[Field, Field]:
        """Evaluate relief, m, and albedo of the wall on a regular grid, (len(v), len(u)) each.

        u, v: coordinates of the grid's columns, along the wall, and of its rows, up the slope, m. The relief's mean plane is
        removed.
        """
        relief = np.empty((len(v), len(u)), np.float32)
        albedo = np.empty_like(relief)
        offset, slope_u, slope_v = self._plane()
        for start in range(0, len(v), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            relief[rows], albedo[rows] = self._evaluate(u, v[rows])
            relief[rows] -= (offset + slope_u * u + slope_v * v[rows, None]).astype(np.float32)
        return relief, albedo

    def _plane(self) -> FloatArray:
        """Return offset and slopes of the least-squares plane through the relief.

        The plane is fitted on a lattice whose spacing does not depend on the resolution.
        """
        u, v = (np.arange(_DETREND_STEP_M / 4, extent, _DETREND_STEP_M) for extent in self.size)
        relief = self._evaluate(u, v)[0].astype(np.float64)
        du, dv = u - u.mean(), v - v.mean()
        slope_u = np.sum(relief * du) / max(np.sum(du**2) * len(v), 1e-9)
        slope_v = np.sum(relief * dv[:, None]) / max(np.sum(dv**2) * len(u), 1e-9)
        return np.array([relief.mean() - slope_u * u.mean() - slope_v * v.mean(), slope_u, slope_v])

    def _evaluate(self, u: FloatArray, v: FloatArray) -> tuple[Field, Field]:
        """Evaluate relief, m, and albedo, with the relief's mean plane still in it."""
        site = self.site
        bent_u = u.astype(np.float32) + self.bend_u.at(u, v)
        bent_v = v.astype(np.float32)[:, None] + self.bend_v.at(u, v)
        bent_v += self.fault.at(bent_u - np.float32(_FAULT_LEAN) * bent_v)
        bed = bent_v - np.float32(site.bed_dip) * bent_u
        patches = self.patches.at(u, v)
        roughness = self.roughness.at(u, v) * np.exp(np.float32(0.4) * patches)
        relief, tone = _sum_layers(self.blocks, bent_u, bent_v, np.clip(1 + np.float32(0.5) * patches, 0.4, 2))
        relief += self.undulation.at(u, v) + self.ledge.at(bed)
        if self.notches:
            relief -= self.notches.at(bent_u, bent_v)
        albedo = site.albedo + self.bed_tone.at(bed) + site.block_tone * tone + site.streaks * self.streaks.at(u, v)
        grain = self.grain.at(u, v)
        if site.band:
            return self._with_band(site.band, bed, (bent_u, bent_v), (relief, roughness), (albedo, grain))
        return relief + roughness, np.clip(albedo + grain, 0.05, 0.9)

    def _with_band(
        self, band: Band, bed: Field, bent: tuple[Field, Field], relief: tuple[Field, Field], albedo: tuple[Field, Field]
    ) -> tuple[Field, Field]:
        """Lay the seam over the rest of the rock: it is recessed, more finely jointed, rougher and of another albedo."""
        above = bed - np.float32(band.at * self.size[1])
        inside = _smooth_step(above / np.float32(0.12)) * _smooth_step((np.float32(band.thickness_m) - above) / np.float32(0.12))
        fragments, tone = _sum_layers(self.band_blocks, *bent, np.ones_like(bed))
        form, roughness = relief
        seam = np.float32(0.5) * form - np.float32(band.recess_m) + fragments
        colour = np.float32(band.albedo) + np.float32(0.015) * tone
        form = form + inside * (seam - form) + roughness * (1 + inside * np.float32(band.roughness - 1))
        return form, np.clip(albedo[0] + inside * (colour - albedo[0]) + albedo[1] * (1 - np.float32(0.6) * inside), 0.05, 0.9)


def _sum_layers(layers: tuple[JointedBlocks, ...], u: Field, v: Field, broken: Field) -> tuple[Field, Field]:
    """Sum the heights, m, and the tones of several generations of blocks.

    The finer ones are weighted by how fractured the rock is.
    """
    height, tone = layers[0].at(u, v)
    for layer in layers[1:]:
        step, shade = layer.at(u, v)
        height += broken * step
        tone += shade
    return height, tone


def _smooth_step(x: Field) -> Field:
    """Return the smoothstep 3 x^2 - 2 x^3 of x, clipped to [0, 1]."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def _beds(random: KeyedRandom, size: Size, site: Site) -> tuple[Table, Table]:
    """Draw how far hard beds protrude, m, and the beds' tones, as functions of the bedding coordinate."""
    draw = random.generator()
    reach = 5.0 + site.bed_dip * size[0]
    edges = draw_partings(draw, -reach, size[1] + reach, site.ledge_bed_m, 0.6)
    hard = np.where(np.arange(len(edges) - 1) % 2, 1.0, -1.0) * draw.uniform(0.3, 1.7, len(edges) - 1)
    tone = site.bed_tone * (0.6 * hard + 0.6 * draw.standard_normal(len(hard)))
    knots = ramp_knots(edges[1:-1], min(0.08, 0.2 * site.ledge_bed_m))
    return (
        Table.through(knots, site.ledge_m * np.repeat(hard, 2)[1:-1]),
        Table.through(knots, np.repeat(tone, 2)[1:-1]),
    )


def _faults(random: KeyedRandom, size: Size, site: Site) -> Table:
    """Draw the displacement of the beds, m, along the wall. It is constant between faults."""
    draw = random.generator()
    edges = draw_partings(draw, -5.0, size[0] + 5.0, site.fault_m, 0.4)
    throw = np.cumsum(site.throw_m * draw.standard_normal(len(edges) - 1) * 0.7)
    return Table.through(ramp_knots(edges[1:-1], 0.04), np.repeat(throw, 2)[1:-1])


def _grid_faces(rows: int, columns: int) -> IntArray:
    """Return the triangles (2 (rows - 1)(columns - 1), 3) of a grid, counter-clockwise.

    Columns run to the right and rows upwards.
    """
    faces = np.empty((rows - 1, columns - 1, 2, 3), np.int32)
    corner = np.arange(columns - 1, dtype=np.int32) + columns * np.arange(rows - 1, dtype=np.int32)[:, None]
    for triangle, corners in enumerate(((0, 1, columns + 1), (0, columns + 1, columns))):
        for k, step in enumerate(corners):
            faces[:, :, triangle, k] = corner + step
    return faces.reshape(-1, 3)

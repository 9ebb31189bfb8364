"""Make walls that are not smooth height fields, errors of their reference, and rock that moved.

All are in the local frame of `surface.py`, m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .surface import Array, Mask, Surface

Rng = np.random.Generator


def fractal(shape: tuple[int, ...], rng: Rng, exponent: float, longest: float = 1.0) -> Array:
    """Draw a random field (a, b) of unit variance whose power falls with frequency to the power -2 exponent.

    Wavelengths reach up to `longest`.
    """
    kx, kz = np.fft.fftfreq(2 * shape[0])[:, None] * shape[0], np.fft.rfftfreq(2 * shape[1])[None] * shape[1]
    k = np.hypot(kx * max(shape) / shape[0], kz * max(shape) / shape[1])
    amplitude = np.where(k >= 1.0 / longest, np.maximum(k, 0.5) ** -exponent, 0.0)
    noise = np.fft.rfft2(rng.standard_normal((2 * shape[0], 2 * shape[1])))
    field = np.fft.irfft2(noise * amplitude, (2 * shape[0], 2 * shape[1]))[: shape[0], : shape[1]]
    return (field - field.mean()) / field.std()


def lines(length: float, spacing: float, rng: Rng, from_: float = 0.0) -> Array:
    """Grid lines from `from_` over `length`, unevenly spaced."""
    gaps = spacing * rng.uniform(0.8, 1.2, max(round(length / spacing), 8))
    return from_ + np.concatenate([[0.0], np.cumsum(gaps)])


def quarry(x: Array, z: Array, rng: Rng) -> Array:
    """Benches of 5 to 9 m with flat tops, drill-hole flutes in the faces."""
    height, tops = np.zeros_like(z), np.cumsum(rng.uniform(5, 9, 12))
    for top in tops:
        height = height - rng.uniform(1.5, 4.0) * (z > top + 0.3 * np.sin(x / rng.uniform(4, 9)))
    flutes = 0.06 * np.abs(np.sin(np.pi * x / rng.uniform(1.6, 2.8)))
    return height + flutes + rng.uniform(0.1, 0.3) * fractal(x.shape, rng, 1.6, 0.2)


def dam(x: Array, z: Array, rng: Rng) -> Array:
    """Return a concrete face: an arch with a batter, blocks of 12 to 16 m, grooves at their joints, and lifts.

    The blocks are set off against each other.
    """
    block, lift = rng.uniform(9, 14), rng.uniform(2.0, 3.2)
    number, place = np.floor(x / block).astype(int), np.mod(x, block)
    offset = rng.normal(0, 0.05, 100)[number - number.min()]
    seams = -0.15 * ((place < 0.25) & (z > 1)) - 0.03 * (np.mod(z, lift) < 0.2)
    gallery = -1.2 * ((np.abs(np.mod(x, 3 * block) - block / 2) < 1.2) & (np.abs(z - rng.uniform(5, 12)) < 1.4))
    arch = -(x**2) / (2 * rng.uniform(60, 150)) - rng.uniform(0.05, 0.25) * z
    return arch + offset + seams + gallery + 0.01 * fractal(x.shape, rng, 1.2)


def portal(x: Array, z: Array, rng: Rng) -> Array:
    """Return a cut slope with the mouth of a tunnel, its frame, wing walls that step back, anchors' heads."""
    middle, radius = rng.uniform(-6, 6), rng.uniform(3.0, 5.0)
    out = np.hypot(x - middle, np.maximum(z - radius - 1, 0.0))
    height = -rng.uniform(0.2, 0.5) * np.maximum(z - 8, 0) + rng.uniform(0.05, 0.15) * fractal(x.shape, rng, 1.9, 0.3)
    height = np.where(np.abs(x - middle) > 2.5 * radius, height - rng.uniform(0.6, 1.6), height)
    height = height + 0.25 * ((np.mod(x, 3.1) < 0.4) & (np.mod(z, 2.7) < 0.4) & (z > 10))
    return np.where(out < radius, height - rng.uniform(3, 6), np.where(out < radius + 0.8, height + 0.6, height))


def roofs(x: Array, z: Array, rng: Rng) -> Array:
    """Return a cliff whose upper parts overhang (roofs), cut by vertical joints, with talus at its foot."""
    height = np.zeros_like(z)
    for place in rng.uniform(6, z.max(), 4):
        edge = place + rng.uniform(-0.4, 0.4) * x + 1.5 * fractal(x.shape, rng, 2.2, 0.5)[:, :1]
        height = height + rng.uniform(0.4, 1.8) * (z > edge)
    for place in rng.uniform(x.min(), x.max(), 9):
        height = height - rng.uniform(0.3, 0.9) * (np.abs(x - place - 0.15 * z) < rng.uniform(0.15, 0.5))
    talus = np.maximum(rng.uniform(3, 6) - z, 0) * rng.uniform(0.8, 1.2)
    return height - 0.1 * z + talus + rng.uniform(0.15, 0.35) * fractal(x.shape, rng, 1.5, 0.4)


def strata(x: Array, z: Array, rng: Rng) -> Array:
    """Dipping beds that weather back by different amounts, with rounded undulation along them."""
    up = z + rng.uniform(-0.3, 0.3) * x + 0.6 * np.sin(x / rng.uniform(5, 12))
    bed = np.floor((up + 40) / rng.uniform(0.7, 1.8)).astype(int)
    back = rng.uniform(-0.5, 0.0, 400)[bed]
    return back + 0.8 * np.sin(x / rng.uniform(6, 14)) + rng.uniform(0.08, 0.2) * fractal(x.shape, rng, 1.3, 0.2)


def wedges(x: Array, z: Array, rng: Rng) -> Array:
    """Blocky rock: the outermost of many planes of two joint sets, rough at small scale."""
    sets = [(0.5, 0.1), (-0.7, -0.2), (0.1, 0.6)]
    saws = [np.abs(np.mod(a * x + b * z + rng.uniform(0, 9), rng.uniform(2.5, 5)) - 1.2) for a, b in sets]
    return np.max(saws, axis=0) + 0.4 * fractal(x.shape, rng, 2.4) + rng.uniform(0.03, 0.1) * fractal(x.shape, rng, 1.1, 0.1)


WALLS: dict[str, Callable[[Array, Array, Rng], Array]] = {
    each.__name__: each for each in (quarry, dam, portal, roofs, strata, wedges)
}


def make(kind: str, rng: Rng, width: float, height: float, spacing: float) -> Surface:
    """Make a wall of `width` x `height` m on grid lines about `spacing` m apart, centred on x = 0, from z = 0 up."""
    x, z = lines(width, spacing, rng, -width / 2), lines(height, spacing * rng.uniform(0.8, 1.25), rng)
    return Surface(x, z, WALLS[kind](*np.meshgrid(x, z, indexing="ij"), rng))


BEND = 0.15  # a bend as large as the other errors could not be told from a lens or a scale


@dataclass(frozen=True)
class ReferenceError:
    """True minus reference: `field` (a, b) m along y, with standard deviation `sigma` m, correlated over about `patch` m."""

    kind: str
    field: Array
    sigma: float
    patch: float


def reference_error(surface: Surface, rng: Rng, sigma: float) -> ReferenceError:
    """Draw an error of the reference as flight strips, tiles, a fractal or a bend cause it."""
    kind = str(rng.choice(["strips", "tiles", "fractal", "bend"]))
    x, z = np.meshgrid(surface.x, surface.z, indexing="ij")
    width, tall = np.ptp(surface.x), np.ptp(surface.z)
    if kind == "strips":
        patch = rng.uniform(3, 7)
        place = x + rng.uniform(-0.3, 0.3) * z
        number = np.floor((place - place.min()) / patch).astype(int)
        field = rng.standard_normal(200)[number] + 0.5 * rng.standard_normal(200)[number] * np.sin(z / patch)
    elif kind == "tiles":
        patch = rng.uniform(3, 8)
        field = rng.standard_normal((100, 100))[((x - x.min()) / patch).astype(int), ((z - z.min()) / patch).astype(int)]
    elif kind == "fractal":
        patch, field = width / 12, fractal(x.shape, rng, rng.uniform(1.5, 2.3), 0.25)
    else:
        patch, sigma = width / 3, sigma * BEND
        a, b, c = rng.standard_normal(3)
        field = a * (2 * x / width) ** 2 + b * (2 * z / tall - 1) ** 2 + c * np.sin(np.pi * x / width) * (2 * z / tall - 1)
    field = field - field.mean()
    return ReferenceError(kind, sigma * field / field.std(), sigma, float(patch))


@dataclass(frozen=True)
class Change:
    """A place where rock moved: middle x, z and half sides m, and how far the surface moved out, m."""

    x: float
    z: float
    half_x: float
    half_z: float
    out: float


def changes(surface: Surface, rng: Rng, count: int) -> list[Change]:
    """Draw fallen blocks (the surface moves in), some with debris at the foot (it moves out)."""
    found = []
    width, tall = np.ptp(surface.x), np.ptp(surface.z)
    for _ in range(count):
        half = rng.uniform(0.6, 1.5, 2)
        x, z = rng.uniform(-0.3, 0.3) * width, rng.uniform(0.3, 0.75) * tall
        found.append(Change(float(x), float(z), float(half[0]), float(half[1]), -float(rng.uniform(0.15, 0.6))))
        if rng.random() < 0.4:
            foot = float(rng.uniform(0.1, 0.25) * tall)
            found.append(Change(float(x + rng.normal()), foot, 1.2, 0.8, float(rng.uniform(0.1, 0.35))))
    return found


def moved(surface: Surface, found: list[Change], rng: Rng) -> Array:
    """Return how far out the surface moved, (a, b), m.

    Blocks leave wedge-shaped scars; debris lies as a mound.
    """
    x, z = np.meshgrid(surface.x, surface.z, indexing="ij")
    out = np.zeros_like(x)
    for each in found:
        u, w = (x - each.x) / each.half_x, (z - each.z) / each.half_z
        tilt = 1 + rng.uniform(-0.4, 0.4) * u + rng.uniform(-0.4, 0.4) * w
        scar = tilt * (np.maximum(np.abs(u), np.abs(w)) < 1)
        mound = np.clip(1 - u**2 - w**2, 0, None) * (1 + 0.3 * rng.standard_normal(x.shape))
        out = out + each.out * (scar if each.out < 0 else mound)
    return out


def albedo(surface: Surface, x: Array, z: Array, rng: Rng) -> Array:
    """(n,) reflectance of the places x, z: dipping stripes of strata, moisture stains that run down, speckle."""
    dip, period = rng.uniform(-0.5, 0.5), rng.uniform(1.5, 5)
    stripe = rng.uniform(0.05, 0.2) * np.sign(np.sin(2 * np.pi * (z + dip * x) / period))
    rho = rng.uniform(0.35, 0.55) + stripe
    for _ in range(rng.integers(1, 6)):
        place, top, half = rng.uniform(surface.x[0], surface.x[-1]), rng.uniform(0.4, 1.0) * surface.z[-1], rng.uniform(0.8, 3)
        rho = np.where((np.abs(x - place - 0.3 * np.sin(z)) < half) & (z < top), rho * rng.uniform(0.25, 0.6), rho)
    return np.clip(rho * np.exp(0.08 * rng.standard_normal(x.shape)), 0.03, 0.95)


def vegetation(surface: Surface, x: Array, z: Array, rng: Rng, count: int) -> Mask:
    """(n,) whether a place was cut out because bushes stood there."""
    hidden = np.zeros(x.shape, bool)
    for _ in range(count):
        middle = rng.uniform(surface.x[0], surface.x[-1]), rng.uniform(surface.z[0], surface.z[-1])
        radius = rng.uniform(0.8, 2.5) * (1 + 0.3 * np.sin(3 * np.arctan2(z - middle[1], x - middle[0])))
        hidden |= np.hypot(x - middle[0], z - middle[1]) < radius
    return hidden

"""Random numbers that depend only on (seed, purpose, element), and so not on threads, chunks or workers.

No generator is advanced: every number is a pure function of its key. On the device, the counter-based Philox 4x32 of Salmon et
al. (2011) is evaluated at the element's index; on the host, NumPy's Philox is seeded with the hashed key.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from scene.common.backend import dr, mi


@dataclass(frozen=True)
class KeyedRandom:
    """Source of random numbers for one purpose, so that each part of a simulation draws its own, whatever else is drawn.

    Attributes
    ----------
    seed : int
        Seed of the run.
    path : tuple of str or int
        The purpose, from wide to narrow, such as ("epoch", 3, "tls", "range_noise").
    """

    seed: int
    path: tuple[str | int, ...] = ()

    def child(self, *purpose: str | int) -> KeyedRandom:
        """Return the source for a narrower purpose, whose words or numbers are appended to this source's.

        Children for different purposes are independent of each other; the same purpose always gives the same numbers.
        """
        return KeyedRandom(self.seed, self.path + purpose)

    @property
    def key(self) -> int:
        """64-bit number that starts this source's random numbers: the BLAKE2b hash of the seed and the purpose."""
        text = repr((self.seed, self.path)).encode()
        return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little")

    def generator(self) -> np.random.Generator:
        """Return a new NumPy generator, which starts at the beginning of this source's random numbers on every call."""
        return np.random.Generator(np.random.Philox(key=self.key))

    def normals(self, index: mi.UInt32, field: int | mi.UInt32 = 0) -> mi.Array4f:
        """Draw four independent standard normal numbers for each of n elements (pixels, pulses), on the ray-tracing device.

        The numbers of an element depend on its number alone, not on which other elements are drawn.

        Parameters
        ----------
        index : mi.UInt32, (n,)
            Element numbers.
        field : int or mi.UInt32, () or (n,)
            A second number of the key, to draw other numbers for the same elements.

        Returns
        -------
        mi.Array4f of (n,) each.
        """
        return self._philox(index, field).next_float32x4_normal()

    def uniforms(self, index: mi.UInt32, field: int | mi.UInt32 = 0) -> mi.Array4f:
        """Draw four independent numbers in [0, 1) for each of n elements (pixels, pulses), on the ray-tracing device.

        index: (n,) element numbers. field: a second number of the key, to draw other numbers for the same elements.
        """
        return self._philox(index, field).next_float32x4()

    def _philox(self, index: mi.UInt32, field: int | mi.UInt32) -> mi.Philox4x32:
        # The key is opaque, so that one compiled kernel serves every seed and purpose.
        return mi.Philox4x32(seed=dr.opaque(mi.UInt64, self.key), counter_0=index, counter_1=mi.UInt32(field))

"""Plan and make the cases of an evaluation.

Strata have quotas, every effect comes in turn, and numbers are shuffled. Folders and truths are kept apart.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap_closed_form import stereo_cases, tls_cases
from benchmarks.gap_closed_form.files import plain

STRATA = ("none", "one", "two", "off", "change")
_CYCLE = (
    *("one", "none", "two", "off", "one", "change", "one", "none", "off", "one"),
    *("two", "none", "one", "change", "one", "off", "none", "one", "two", "one"),
)
SENSORS = ("tls", "stereo")
_ORDER = ("tls", "stereo", "tls", "stereo", "tls")
_MAKERS = {"tls": tls_cases, "stereo": stereo_cases}
_SMALL = ((5_000, 6_500), (5_000, 6_000))
_USUAL = ((5_000, 40_000), (10_000, 40_000))
_LARGE_EVERY, _LARGE = 40, 150_000


@dataclass(frozen=True)
class Case:
    """A planned case.

    Attributes
    ----------
    number : Number by which the case is named.
    seed : Seed of everything in it.
    kinds : Names of its effects, including forms outside the catalogue.
    """

    number: int
    seed: tuple[int, int]
    stratum: str
    sensor: str
    kinds: tuple[str, ...]
    points: int
    nodes: int

    @property
    def name(self) -> str:
        """Name of the folder and of the truth's file."""
        return f"{self.number:04d}"


def plan(count: int, seed: int, small: bool = False) -> list[Case]:
    """Return the cases of an evaluation, by number. small: with only some thousand points, for a test."""
    random = np.random.default_rng([seed, 1])
    numbers = random.permutation(count)
    decks = {(sensor, off): _Deck(_MAKERS[sensor], off, random) for sensor in _MAKERS for off in (False, True)}
    drawn = dict.fromkeys(STRATA, 0)
    found = []
    for index in range(count):
        stratum = _CYCLE[index % len(_CYCLE)]
        sensor = _ORDER[drawn[stratum] % len(_ORDER)]
        drawn[stratum] += 1
        deck = decks[sensor, stratum == "off"]
        kinds = deck.draw({"one": 1, "two": 2, "off": 1}.get(stratum, 0))
        points, nodes = (int(np.exp(random.uniform(*np.log(ends)))) for ends in (_SMALL if small else _USUAL))
        if not small and index % _LARGE_EVERY == _LARGE_EVERY - 1:
            points = _LARGE
        found.append(Case(int(numbers[index]), (seed, index), stratum, sensor, kinds, points, nodes))
    return sorted(found, key=lambda case: case.number)


class _Deck:
    """Deals effects in random order, repeatedly."""

    def __init__(self, maker: Any, off: bool, random: np.random.Generator) -> None:
        self._names = random.permutation(maker.OFF_CATALOGUE if off else maker.CATALOGUE).tolist()
        self._next = 0

    def draw(self, count: int) -> tuple[str, ...]:
        chosen = tuple(self._names[(self._next + k) % len(self._names)] for k in range(count))
        self._next += count
        return chosen


def make(case: Case, folder: Path, truth: Path, baselines: bool = True) -> None:
    """Write the measurement into `folder` and its truth into the file `truth`.

    baselines: whether the truth holds the answers of the baselines too, which take most of the time; the measurement is the same.
    """
    random = np.random.default_rng([*case.seed, 2])
    folder.mkdir(parents=True, exist_ok=True)
    falls = {"none": 0, "change": int(random.integers(2, 7))}.get(case.stratum, int(random.choice([0, 0, 1, 2, 3])))
    found = _MAKERS[case.sensor].make(folder, random, list(case.kinds), falls, case.points, case.nodes, baselines)
    truth.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(plain({"number": case.number, "seed": case.seed, "stratum": case.stratum, **found}), indent=1)
    part = truth.with_suffix(".part")
    part.write_text(text)
    part.replace(truth)

"""Switch off single steps of `gap`, one at a time, and print the answers that change. `run.py` does so on stored cases.

    python benchmarks/gap_ablation/steps.py FOLDER [FOLDER ...] [--step NAME ...]

A FOLDER is a measurement or holds measurements. Each is diagnosed with all steps, and once without each step that is named
(default: every step of `STEPS`). An answer is the verdict with the named effects, each with those that it cannot be told from.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

from pipeline.formats.measurements.measurement import FILE, read_measurement
from pipeline.gap.mean.search import MeanSearch
from pipeline.gap.naming import effect_selection, nonlinear_refit, validation_scores, workflow
from pipeline.gap.naming.selection_passes import PassInputs
from pipeline.gap.naming.validation_scores import ValidatedEffects
from pipeline.gap.noise_and_edges import disparity_edges, variance_model

STEPS: dict[str, tuple[Any, str, Any]] = {
    "each effect is tried alone": (nonlinear_refit, "_screened_single_fits", lambda given, first, alone: alone),
    "relinearised selection": (nonlinear_refit, "_relinearised", lambda given, linear: (linear, False)),
    "pose beside edge fattening": (workflow, "align_beside_fattening", lambda pair, initial, found, trusted: found),
    "windows of edge fattening": (disparity_edges, "_WINDOWS", ()),
    "edge effects searched again": (effect_selection.SelectionStart, "outline", lambda start: []),
    "tiles with unequal shifts": (effect_selection, "_unequal_tiles", lambda *_: None),
    "overtones of a wave": (MeanSearch, "_with_overtones", lambda search, members, form: form),
    "groups of effects validated": (validation_scores, "_groups", lambda effects: []),
    "weak effects left out": (validation_scores, "_is_weak", lambda item, gains, most: False),
    "weak effects named again": (ValidatedEffects, "with_needed", lambda found, selection: found),
    "best single effect": (PassInputs, "_best_single_effect", property(lambda inputs: None)),
    "variance that neighbours share": (variance_model, "_unshared_share", lambda *_: 1.0),
    "heavy tails": (workflow, "_with_heavy_tails", lambda measurement, named, blocks: (named, None)),
    "selection without empirical terms": (workflow, "_has_alternatives", lambda inputs, dropped: False),
}
"""What replaces each step: the module or class that holds it, its name there, and a replacement that does nothing."""


@contextmanager
def switched_off(steps: Sequence[str]) -> Iterator[None]:
    """Switch off steps, by their names in `STEPS`, inside a `with` block."""
    with ExitStack() as off:
        for owner, name, nothing in (STEPS[step] for step in steps):
            off.enter_context(patch.object(owner, name, nothing))
        yield


@contextmanager
def noting_steps(used: set[str]) -> Iterator[None]:
    """Add the names of steps that run inside a `with` block to `used`."""
    with ExitStack() as on:
        for step, (owner, name, _) in STEPS.items():
            on.enter_context(patch.object(owner, name, _noting(vars(owner)[name], step, used)))
        yield


def _noting(part: Any, step: str, used: set[str]) -> Any:
    """Return a part of the program (a function, cached property or tuple) that adds the step to `used` when it is used."""
    if isinstance(part, cached_property):
        return property(_noting(part.__get__, step, used))
    if isinstance(part, tuple):
        return _NotedTuple(part, step, used)

    def called(*arguments: Any, **options: Any) -> Any:
        used.add(step)
        return part(*arguments, **options)

    return called


class _NotedTuple:
    """The items of a tuple, which adds a step to a set when they are read in turn."""

    def __init__(self, items: tuple[Any, ...], step: str, used: set[str]) -> None:
        self._items, self._step, self._used = items, step, used

    def __iter__(self) -> Iterator[Any]:
        self._used.add(self._step)
        return iter(self._items)


def answer(folder: Path, steps: Sequence[str] = ()) -> str:
    """Return verdict and named effects of a measurement. steps: names of the steps to switch off."""
    with switched_off(steps):
        found = workflow.diagnose(read_measurement(folder))
    named = (f"{item.name} {{{', '.join(item.indistinguishable)}}}" for item in found.effects)
    return f"{found.verdict}: {', '.join(named) or 'nothing named'}"


def measurements(folders: list[Path]) -> Iterator[Path]:
    """Folders of measurements, in the order of their names."""
    for folder in folders:
        yield from [folder] if (folder / FILE).exists() else sorted(each.parent for each in folder.glob(f"*/{FILE}"))


def main() -> None:
    """Print the answers that change without a step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="a measurement, or a folder of measurements")
    parser.add_argument("--step", action="append", choices=list(STEPS), help="switch off only this step; may be repeated")
    given = parser.parse_args()
    for folder in measurements(given.folders):
        usual = answer(folder)
        print(f"{folder}: {usual}", flush=True)
        for step in given.step or STEPS:
            without = answer(folder, [step])
            if without != usual:
                print(f"  without {step}: {without}", flush=True)


if __name__ == "__main__":
    main()

"""What single choices of the detector's training are worth: trainings of equal length, each with one choice undone.

    python benchmarks/detector_ablation.py --out runs/ablation [--epochs 24] [--seeds 1 2] [--placement mean_surface] [--write]

Medium blocks at 2.5 cm of noise, walls and sensors of configs/datasets/detector.yaml. Every network starts from random weights;
the score that counts is set on the validation images, F1 is of test epochs. What is there already is not made again. A
difference from the first row is of the means over the seeds; its standard error comes from the seeds' spread, pooled over the
rows. --write puts the table into docs/detector.md.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from documents import write_between

from pipeline.config.bundled import bundled_config
from pipeline.dataset.config import load_dataset_config
from pipeline.dataset.run import make_dataset
from pipeline.detection.config import BEST, load_train_config
from pipeline.detection.evaluate import evaluate
from pipeline.detection.run import LOWEST_SCORE, detect
from pipeline.detection.training import train

DOCUMENT = Path(__file__).parents[1] / "docs" / "detector.md"
MARKS = "<!-- ablation -->", "<!-- end of ablation -->"
CONFIDENCE, OVERLAPS = 0.95, (0.25, 0.75)
SET = ("parts.0.noise=[2.5cm]", "parts.0.sizes=[medium]", "parts.0.train=4", "parts.0.val=2", "parts.0.test=2", "name=ablation")


@dataclass(frozen=True)
class Change:
    """A choice undone: overrides of the training's config and of the data set's."""

    name: str
    training: tuple[str, ...] = ()
    data: tuple[str, ...] = ()


CHANGES = (
    Change("as it is"),
    Change("no mirror images", ("training.flips=false",)),
    Change("smallest anchor 8 px in place of 4", ("detector.proposal.anchor_sizes_px=[8, 14, 24, 48, 128]",)),
    Change("box losses weighted 0.2 (proposals) and 0.5", ("training.loss_weights={proposal_box: 0.2, box: 0.5}",)),
    Change("no block left out of the loss", data=("annotation.ignore_below=0",)),
)


def f1(change: Change, seed: int, arguments: argparse.Namespace) -> list[float]:
    """Of a training with that change and seed, at each of OVERLAPS, %."""
    folder = arguments.out / f"{CHANGES.index(change)}_{seed}"
    test = data_set(change, arguments) / "test"
    found = folder / "found" / "detections.json"
    if not found.exists():
        overrides = (f"training.epochs={arguments.epochs}", f"training.seed={seed}", *change.training)
        config = load_train_config(bundled_config("detectors", "fine"), overrides)
        train(test.parent, config, folder, resume=True)
        detect(str(folder / BEST), [test], found.parent, confidences=(LOWEST_SCORE,), pictures=False)
    truth = json.loads((test / "annotations.json").read_text(encoding="utf-8"))
    predictions = json.loads(found.read_text(encoding="utf-8"))["annotations"]
    return [100 * score.f1 for score in evaluate(truth, predictions, None, (CONFIDENCE,), OVERLAPS)]


def data_set(change: Change, arguments: argparse.Namespace) -> Path:
    """The set that a change learns from, made once."""
    folder = Path(arguments.out / f"set_{CHANGES.index(change) if change.data else 0}")
    if not (folder / "test").is_dir():
        overrides = (*SET, f"sizes.medium.rockfall.placement={arguments.placement}", *change.data)
        make_dataset(load_dataset_config(bundled_config("datasets", "detector"), overrides), folder)
    return folder


def rows(figures: Sequence[Sequence[Sequence[float]]]) -> Iterator[str]:
    """The table's, in Markdown. figures: F1 by change, seed and overlap, %."""
    yield f"| change | F1, {len(figures[0])} trainings: {OVERLAPS[0]:g} | {OVERLAPS[1]:g} | against the first row |"
    yield "|---|---|---|---|"
    values = np.array(figures)
    means = values.mean(axis=1)
    error = np.sqrt(values.var(axis=1, ddof=1).mean(axis=0) * 2 / values.shape[1]) if values.shape[1] > 1 else [math.nan] * 2
    for change, mean in zip(CHANGES, means, strict=True):
        gains = ", ".join(f"{gain:+.1f} +- {one:.1f}" for gain, one in zip(mean - means[0], error, strict=True))
        yield f"| {change.name} | {mean[0]:.1f} % | {mean[1]:.1f} % | {'' if change is CHANGES[0] else gains} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="for sets and detectors")
    parser.add_argument("--epochs", type=int, default=24, help="passes over the training images")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--placement", choices=("relief", "mean_surface"), default="relief")
    parser.add_argument("--write", action="store_true", help="put the table into docs/detector.md")
    arguments = parser.parse_args()
    text = "\n".join(rows([[f1(change, seed, arguments) for seed in arguments.seeds] for change in CHANGES]))
    print(text)
    if arguments.write:
        write_between(DOCUMENT, MARKS, text)


if __name__ == "__main__":
    main()

r"""Measure what single choices of the detector's training contribute.

Trainings are short and of equal length; each has one choice undone.

    python benchmarks/detector_ablation.py --set sets/mixed --test sets/detector_test --test sets/detector_test_mean \
        --out runs/ablation [--epochs 8] [--seeds 1 2] [--write]

The blocks are small and medium, at one noise level, from sets as in detector_table.py. Every network starts from random weights;
score thresholds are set on the validation images; F1 is of all tests together. Results in --out are reused. The first row is
trained once for each of --seeds, which shows the effect of chance; the others are trained with the first seed and compared with
the mean of that row. --write puts the table into docs/validation/detector_training.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from documents import write_between

from pipeline.config.bundled import bundled_config
from pipeline.detection.evaluation.evaluate import evaluate
from pipeline.detection.inference.operating_point import set_operating_point
from pipeline.detection.network.config import BEST, load_train_config
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.products.run import LOWEST_SCORE, detect
from pipeline.detection.training.training import train

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation" / "detector_training.md"
MARKS = "<!-- ablation -->", "<!-- end of ablation -->"
CONFIDENCE, OVERLAPS = 0.95, (0.25, 0.75)
BATCH = 4
"""Half of the config's batch: in short trainings, the number of steps matters more than their noise."""
NOISE, SIZES = "2.5cm", ("small", "medium")
ONE_WALL = {"wall": "glendale", "sensor": "stereo", "size_class": "medium"}
"""Images for setting scores where validation does not use all of them."""
Coco = dict[str, Any]


@dataclass(frozen=True)
class Change:
    """A choice undone.

    Attributes
    ----------
    training : Overrides of the training's config.
    ignore : Whether faint blocks are left out of the loss.
    one_wall : Whether the network is that of the first row, with its scores set on ONE_WALL only.
    """

    name: str
    training: tuple[str, ...] = ()
    ignore: bool = True
    one_wall: bool = False


CHANGES = (
    Change("as it is"),
    Change("mirrored left-right alone", ("training.flips=left_right",)),
    Change("smallest anchor 8 px in place of 4", ("detector.proposal.anchor_sizes_px=[8, 14, 24, 48, 128]",)),
    Change("box losses weighted 0.2 (proposals) and 0.5", ("training.loss_weights={proposal_box: 0.2, box: 0.5}",)),
    Change("faint blocks (ratio below 2) count in the loss", ignore=False),
    Change("scores set on one wall, sensor and size", one_wall=True),
)


def figures(change: Change, seed: int, arguments: argparse.Namespace) -> list[float]:
    """Return F1, %, by size and overlap, of a training with that change and seed."""
    folder = arguments.out / f"{CHANGES.index(change)}_{seed}"
    tests = [part(each / "test", arguments.out / f"test_{number}") for number, each in enumerate(arguments.tests)]
    found = [folder / f"found_{number}" / "detections.json" for number in range(len(tests))]
    if not all(path.exists() for path in found):
        detector = one_wall(seed, folder, arguments) if change.one_wall else trained(change, seed, folder, arguments)
        for test, path in zip(tests, found, strict=True):
            detect(str(detector), [test], path.parent, confidences=(LOWEST_SCORE,), pictures=False)
    counts = np.zeros((len(SIZES), len(OVERLAPS), 2))
    for test, path in zip(tests, found, strict=True):
        truth, predictions = content(test), json.loads(path.read_text(encoding="utf-8"))["annotations"]
        groups = {size: [image["id"] for image in truth["images"] if image["size_class"] == size] for size in SIZES}
        for score in evaluate(truth, predictions, groups, (CONFIDENCE,), OVERLAPS):
            right, wrong = 2 * score.true_positives, score.false_positives + score.false_negatives
            counts[SIZES.index(score.group), OVERLAPS.index(score.iou)] += right, right + wrong
    return list(100 * (counts[..., 0] / counts[..., 1]).ravel())


def trained(change: Change, seed: int, folder: Path, arguments: argparse.Namespace) -> Path:
    """Return the detector of a training with that change."""
    base = (
        f"training.epochs={arguments.epochs}",
        f"training.seed={seed}",
        f"training.batch={BATCH}",
        "training.precision=bfloat16",
    )
    config = load_train_config(bundled_config("detectors", "fine"), (*base, *change.training))
    name = "set" if change.ignore else "set_that_ignores_nothing"
    for split in ("train", "val"):
        part(arguments.folder / split, arguments.out / name / split, ignore=change.ignore)
    train(arguments.out / name, config, folder, resume=True)
    return Path(folder / BEST)


def one_wall(seed: int, folder: Path, arguments: argparse.Namespace) -> Path:
    """Return the detector of the first row with its scores set on ONE_WALL; that row must come first."""
    validation = part(
        arguments.folder / "val",
        arguments.out / "one_wall" / "val",
        wanted=lambda image: all(image[key] == value for key, value in ONE_WALL.items()),
    )
    shutil.copytree(arguments.out / f"0_{seed}" / BEST, folder / BEST, dirs_exist_ok=True)
    set_operating_point(folder / BEST, CocoFolder(validation))
    return Path(folder / BEST)


def part(folder: Path, out: Path, *, ignore: bool = True, wanted: Callable[[Coco], bool] = lambda image: True) -> Path:
    """Copy the wanted images of a COCO folder, at NOISE and of SIZES, to `out`, once."""
    if (out / "annotations.json").exists():
        return out
    whole = content(folder)
    chosen = [image for image in whole["images"] if image["noise"] == NOISE and image["size_class"] in SIZES and wanted(image)]
    numbers = {image["id"] for image in chosen}
    annotations = [each if ignore else {**each, "ignore": 0} for each in whole["annotations"] if each["image_id"] in numbers]
    out.mkdir(parents=True, exist_ok=True)
    for image in chosen:
        shutil.copy(folder / image["file_name"], out)
    text = json.dumps({**whole, "images": chosen, "annotations": annotations})
    (out / "annotations.json").write_text(text, encoding="utf-8")
    return out


def content(folder: Path) -> Coco:
    """Return a folder's annotations."""
    return dict(json.loads((folder / "annotations.json").read_text(encoding="utf-8")))


def rows(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the rows of the table, in Markdown, as they are made."""
    heads = [f"{size}: {', '.join(f'{overlap:g}' for overlap in OVERLAPS)}" for size in SIZES]
    yield f"| change | {' | '.join(heads)} | against the first row |"
    yield "|---" * (2 + len(SIZES)) + "|"
    first, *others = CHANGES
    seeds = [figures(first, seed, arguments) for seed in arguments.seeds]
    base = np.mean(seeds, axis=0)
    yield row(first, base, "seeds lie apart by " + pairs(np.ptp(seeds, axis=0), "{:.1f}"))
    for change in others:
        found = np.array(figures(change, arguments.seeds[0], arguments))
        yield row(change, found, pairs(found - base, "{:+.1f}"))


def row(change: Change, values: Any, last: str) -> str:
    """One line of it. values: F1 by size and overlap, %; last: its last cell."""
    return f"| {change.name} | {pairs(values, '{:.1f}').replace('; ', ' | ')} | {last} |"


def pairs(values: Any, form: str) -> str:
    """Numbers by size and overlap, the sizes' apart by semicolons."""
    return "; ".join(", ".join(form.format(value) for value in row) for row in np.reshape(values, (len(SIZES), len(OVERLAPS))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=Path, required=True, dest="folder", help="to learn from, with train/ and val/")
    parser.add_argument("--test", type=Path, required=True, action="append", dest="tests", help="what detector_test.yaml makes")
    parser.add_argument("--out", type=Path, required=True, help="for sets and detectors")
    parser.add_argument("--epochs", type=int, default=8, help="passes over the training images")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector_training.md")
    arguments = parser.parse_args()
    table = []
    for line in rows(arguments):
        print(line, flush=True)
        table.append(line)
    if arguments.write:
        write_between(DOCUMENT, MARKS, "\n".join(table))


if __name__ == "__main__":
    main()

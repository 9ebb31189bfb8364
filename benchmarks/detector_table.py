"""F1 of a detector and of the threshold baseline, beside the thesis's: four walls x three levels of noise x three sizes.

    scarpsim dataset configs/datasets/detector_test.yaml --out runs/detector_test       # goes on where it was interrupted
    python benchmarks/detector_table.py --set runs/detector_test [--model default] [--write]

To reach: more than the baseline wherever the baseline has less than 95 %. Detections are kept under --out and not made again.
Confidence 0.95, and an IoU of 0.25 (was the block found?) and of 0.75 (how well is it drawn?) of masks and of boxes; of boxes at
0.75 the thesis has tables 5-9 to 5-12. The baseline gets the lowest score to count, of a few, that
is best for it over all cells. Beside it how many blocks stand out from the noise at all. --write puts the tables into
docs/detector.md.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.change.annotate import STANDS_OUT
from pipeline.detection.evaluate import Overlap, Score, evaluate
from pipeline.detection.run import BASELINE, LOWEST_SCORE, detect
from pipeline.formats.atomic import write_text

DOCUMENT = Path(__file__).parents[1] / "docs" / "detector.md"
MARKS = "<!-- table -->", "<!-- end of table -->"
CONFIDENCE, FOUND, DRAWN = 0.95, 0.25, 0.75
BASELINE_SCORES = (LOWEST_SCORE, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
ENOUGH = 0.95
SIZES = ("small", "medium", "large")
THESIS = {
    "glendale-b": {"2.5cm": (82.1, 93.6, 95.1), "5cm": (72.8, 89.0, 94.4), "7.5cm": (39.3, 84.0, 93.3)},
    "bulga-b": {"2.5cm": (86.7, 96.6, 94.1), "5cm": (74.8, 90.8, 94.7), "7.5cm": (46.3, 84.6, 93.1)},
    "bismantova": {"2.5cm": (84.1, 94.2, 97.3), "5cm": (61.1, 87.0, 96.5), "7.5cm": (29.5, 78.9, 94.7)},
    "pilkington": {"2.5cm": (83.1, 94.0, 95.1), "5cm": (59.0, 84.2, 94.9), "7.5cm": (40.1, 75.5, 93.7)},
}
"""F1 of small, medium and large blocks, %, tables 5-9 to 5-12."""
Coco = dict[str, Any]


def detections(model: str, folder: Path, out: Path) -> list[dict[str, Any]]:
    """What the model finds in the set's tests, made once."""
    path = out / "detections.json"
    if not path.exists():
        detect(model, [folder], out, confidences=(LOWEST_SCORE,), pictures=False)
    return list(json.loads(path.read_text(encoding="utf-8"))["annotations"])


def cells_of(truth: Coco, sensors: tuple[str, ...]) -> dict[str, list[int]]:
    """Ids of the images by `wall noise size`."""
    cells: dict[str, list[int]] = {}
    for image in truth["images"]:
        if image["sensor"] in sensors:
            cells.setdefault(f"{image['wall']} {image['noise']} {image['size_class']}", []).append(image["id"])
    return cells


@dataclass(frozen=True)
class Bar:
    """What counts as found: an overlap of masks or boxes."""

    iou: float
    kind: Overlap

    def __str__(self) -> str:
        return f"F1 at an IoU of {'masks' if self.kind == 'segm' else 'boxes'} of {self.iou:g}, %:"


def scores(truth: Coco, found: list[dict[str, Any]], confidence: float, bar: Bar, sensors: tuple[str, ...]) -> dict[str, Score]:
    """By `wall noise size`."""
    counted = evaluate(truth, found, cells_of(truth, sensors), (confidence,), (bar.iou,), bar.kind)
    return {score.group: score for score in counted}


def best_scores(truth: Coco, found: list[dict[str, Any]], bar: Bar, sensors: tuple[str, ...]) -> dict[str, Score]:
    """As `scores`, at the one of BASELINE_SCORES with the largest mean F1."""
    choices = [scores(truth, found, lowest, bar, sensors) for lowest in BASELINE_SCORES]
    return max(choices, key=_mean_f1)


def visible(truth: Coco, sensors: tuple[str, ...]) -> dict[str, str]:
    """By `wall noise size`, how many % of the blocks stand out from the noise, to a filter that knows their shapes."""
    ratios: dict[int, list[float]] = {image["id"]: [] for image in truth["images"]}
    for block in truth["annotations"]:
        ratios[block["image_id"]].append(block.get("signal_to_noise") or 0.0)
    every = {cell: [one for number in numbers for one in ratios[number]] for cell, numbers in cells_of(truth, sensors).items()}
    return {cell: f"{100 * sum(one > STANDS_OUT for one in found) / max(len(found), 1):.0f}" for cell, found in every.items()}


def table(network: dict[str, Score], baseline: dict[str, Score], last: dict[str, str], head: str) -> Iterator[str]:
    """Rows of Markdown: detector, baseline and a third figure for each size, in %. head: of the third."""
    yield "| wall | noise | " + " | ".join(f"{size}: detector, baseline, {head}" for size in SIZES) + " |"
    yield "|---|---|" + "---|" * len(SIZES)
    for wall, levels in THESIS.items():
        for noise in levels:
            keys = [f"{wall} {noise} {size}" for size in SIZES]
            if all(key in network for key in keys):
                cells = [f"{_marked(network[key], baseline[key])}, {100 * baseline[key].f1:.0f}, {last[key]}" for key in keys]
                yield f"| {wall} | {noise} | " + " | ".join(cells) + " |"


def lost(network: dict[str, Score], baseline: dict[str, Score]) -> list[str]:
    """The cells in which the baseline has less than 95 % and the detector no more than the baseline."""
    return [key for key, score in baseline.items() if score.f1 < ENOUGH and not network[key].f1 > score.f1]


def summary(network: dict[str, Score], baseline: dict[str, Score]) -> str:
    """The comparison as a sentence, with the mean over the cells."""
    means = [100 * _mean_f1(each) for each in (network, baseline)]
    lowest = next(iter(baseline.values())).confidence
    beaten = sum(score.f1 < ENOUGH for score in baseline.values())
    cells = lost(network, baseline)
    blocks = [score.true_positives + score.false_negatives for score in network.values()]
    spread = 100 * max(math.sqrt(0.25 / max(count, 1)) for count in blocks)
    worst = f"; it is not better in: {', '.join(cells)}" if cells else ""
    return (
        f"Mean F1 over {len(network)} cells: detector {means[0]:.1f} %, baseline {means[1]:.1f} % "
        f"(scores of {lowest:g} or more). The detector is better in "
        f"{beaten - len(cells)} of the {beaten} cells in which the baseline has less than 95 %{worst}. "
        f"{min(blocks)} to {max(blocks)} blocks a cell; a cell's standard error is at most {spread:.1f} %."
    )


def _mean_f1(cells: dict[str, Score]) -> float:
    return sum(score.f1 for score in cells.values()) / len(cells)


def _marked(score: Score, rival: Score) -> str:
    text = f"{100 * score.f1:.0f}"
    return f"**{text}**" if score.f1 > rival.f1 else text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=Path, required=True, dest="folder", help="the set that detector_test.yaml makes")
    parser.add_argument("--model", default="default", help="default, or a trained detector's folder")
    parser.add_argument("--out", type=Path, help="for the detections (default: a folder beside the set's)")
    parser.add_argument("--sensors", nargs="+", default=["stereo", "tls"])
    parser.add_argument("--write", action="store_true", help="put the table into docs/detector.md")
    arguments = parser.parse_args()
    test, out = arguments.folder / "test", arguments.out or arguments.folder.with_name(f"{arguments.folder.name}_found")
    truth = json.loads((test / "annotations.json").read_text(encoding="utf-8"))
    sensors = tuple(arguments.sensors)
    found, rival = detections(arguments.model, test, out / "network"), detections(BASELINE, test, out / BASELINE)
    thesis = {
        f"{wall} {noise} {size}": f"{figure:.0f}"
        for wall, levels in THESIS.items()
        for noise, figures in levels.items()
        for size, figure in zip(SIZES, figures, strict=True)
    }
    parts = []
    seen = visible(truth, sensors)
    tables: list[tuple[Bar, dict[str, str], str]] = [
        (Bar(FOUND, "segm"), seen, "stand out"),
        (Bar(FOUND, "bbox"), seen, "stand out"),
    ]
    tables += [(Bar(DRAWN, "segm"), thesis, "thesis"), (Bar(DRAWN, "bbox"), thesis, "thesis")]
    for bar, third, head in tables:
        network = scores(truth, found, CONFIDENCE, bar, sensors)
        baseline = best_scores(truth, rival, bar, sensors)
        parts += [str(bar), "", *table(network, baseline, third, head), "", summary(network, baseline), ""]
    text = "\n".join(parts).rstrip()
    print(text)
    if arguments.write:
        document = DOCUMENT.read_text(encoding="utf-8")
        first, last = MARKS
        write_text(DOCUMENT, re.sub(f"{first}.*{last}", lambda _: f"{first}\n{text}\n{last}", document, flags=re.DOTALL))


if __name__ == "__main__":
    main()

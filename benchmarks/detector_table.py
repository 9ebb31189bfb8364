"""Measure F1 of a detector and of the threshold baseline, compared with the thesis: four walls, three noise levels, three sizes.

    scarpsim dataset configs/datasets/detector_test.yaml --out runs/detector_test       # continues an interrupted run
    python benchmarks/detector_table.py --set runs/detector_test [--set another] [--model default] [--mirrored] [--write]

Each set, named by the placement of its blocks (`rockfall.placement`), gets tables of the stereo pair's and of the laser scanner's
maps. Detections are kept in a folder beside the set's (--out) and reused. The confidence is 0.95, with an IoU of 0.25 (is the
block found?) and of 0.75 (is it well drawn?), of masks and of boxes; the thesis has tables 5-9 to 5-12 for boxes at 0.75.

Target: more than the baseline wherever the baseline has less than 95 %. The baseline's score threshold is the best one, of a few,
over the cells of a table. --write puts the tables into docs/validation/detector_tables.md, and their means over the walls into
docs/validation/detector.md.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from documents import write_between

from pipeline.detection.evaluation.evaluate import Overlap, Score, evaluate
from pipeline.detection.products.run import BASELINE, LOWEST_SCORE, detect

DOCS = Path(__file__).parents[1] / "docs" / "validation"
MARKS = "<!-- table -->", "<!-- end of table -->"
CONFIDENCE, FOUND, DRAWN = 0.95, 0.25, 0.75
BASELINE_SCORES = (LOWEST_SCORE, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
ENOUGH = 0.95
SIZES = ("small", "medium", "large")
SENSORS = {"stereo": "stereo pair", "tls": "laser scanner"}
THESIS = {
    "glendale-b": {"2.5cm": (82.1, 93.6, 95.1), "5cm": (72.8, 89.0, 94.4), "7.5cm": (39.3, 84.0, 93.3)},
    "bulga-b": {"2.5cm": (86.7, 96.6, 94.1), "5cm": (74.8, 90.8, 94.7), "7.5cm": (46.3, 84.6, 93.1)},
    "bismantova": {"2.5cm": (84.1, 94.2, 97.3), "5cm": (61.1, 87.0, 96.5), "7.5cm": (29.5, 78.9, 94.7)},
    "pilkington": {"2.5cm": (83.1, 94.0, 95.1), "5cm": (59.0, 84.2, 94.9), "7.5cm": (40.1, 75.5, 93.7)},
}
"""F1 of small, medium and large blocks, %, tables 5-9 to 5-12."""
LEVELS = tuple(THESIS["glendale-b"])
Coco = dict[str, Any]


@dataclass(frozen=True)
class Bar:
    """What counts as found: an overlap of masks or boxes."""

    iou: float
    kind: Overlap

    def __str__(self) -> str:
        return f"IoU of {'masks' if self.kind == 'segm' else 'boxes'} of {self.iou:g}"


BARS = (Bar(FOUND, "segm"), Bar(FOUND, "bbox"), Bar(DRAWN, "segm"), Bar(DRAWN, "bbox"))


@dataclass(frozen=True)
class Tested:
    """A test set, the placement of its blocks, and what the two detectors find in it."""

    placement: str
    truth: Coco
    network: list[dict[str, Any]]
    baseline: list[dict[str, Any]]

    @classmethod
    def of(cls, folder: Path, model: str, out: Path, *, mirrored: bool = False) -> Tested:
        """Read the set in `folder`; detections are kept in `out` and made only once. mirrored: with mirrored views."""
        truth = json.loads((folder / "test" / "annotations.json").read_text(encoding="utf-8"))
        network = detections(model, folder / "test", out, mirrored=mirrored)
        return cls(placement_of(folder), truth, network, detections(BASELINE, folder / "test", out))

    def on(self, *sensors: str) -> Cells:
        """Return the cells of these sensors, taken together."""
        cells: dict[str, list[int]] = {}
        for image in self.truth["images"]:
            if image["sensor"] in sensors:
                cells.setdefault(f"{image['wall']} {image['noise']} {image['size_class']}", []).append(image["id"])
        return Cells(self, " and ".join(SENSORS[sensor] for sensor in sensors), cells)


def placement_of(folder: Path) -> str:
    """Return the placement of a set's blocks, from its dataset.json; several are joined by `and`."""
    sources = json.loads((folder / "dataset.json").read_text(encoding="utf-8"))["sources"].values()
    found = {size["rockfall"]["placement"] for source in sources for size in source["config"]["sizes"].values()}
    return " and ".join(sorted(found))


def detections(model: str, folder: Path, out: Path, *, mirrored: bool = False) -> list[dict[str, Any]]:
    """Return what a detector finds in a set's tests, made once. mirrored: with mirrored views."""
    path = out / (BASELINE if model == BASELINE else "mirrored" if mirrored else "network") / "detections.json"
    if not path.exists():
        detect(model, [folder], path.parent, confidences=(LOWEST_SCORE,), pictures=False, mirrored=mirrored)
    return list(json.loads(path.read_text(encoding="utf-8"))["annotations"])


@dataclass(frozen=True)
class Cells:
    """The cells of one set: image ids by `wall noise size`. sensors: whose images, in words."""

    tested: Tested
    sensors: str
    images: dict[str, list[int]]

    def network(self, bar: Bar) -> dict[str, Score]:
        """Return the detector's scores by cell."""
        return self._scores(self.tested.network, CONFIDENCE, bar)

    def baseline(self, bar: Bar) -> dict[str, Score]:
        """Return the baseline's scores, at that of BASELINE_SCORES with the largest mean F1."""
        return max((self._scores(self.tested.baseline, lowest, bar) for lowest in BASELINE_SCORES), key=mean_f1)

    def _scores(self, found: list[dict[str, Any]], confidence: float, bar: Bar) -> dict[str, Score]:
        counted = evaluate(self.tested.truth, found, self.images, (confidence,), (bar.iou,), bar.kind)
        return {score.group: score for score in counted}

    @cached_property
    def visible(self) -> dict[str, float]:
        """Return the share of blocks that stand out from the noise for a matched filter."""
        return {name: score.stand_out for name, score in self.network(BARS[0]).items()}


def tables(cells: Cells) -> Iterator[str]:
    """Lines of Markdown: a table for each bar."""
    for bar in BARS:
        network, baseline = cells.network(bar), cells.baseline(bar)
        head = "stand out" if bar.iou == FOUND else "thesis"
        yield from (
            f"F1 at an {bar}, %:",
            "",
            "| wall | noise | " + " | ".join(f"{size}: detector, baseline, {head}" for size in SIZES) + " |",
        )
        yield "|---|---|" + "---|" * len(SIZES)
        for wall in THESIS:
            for noise in LEVELS:
                keys = [f"{wall} {noise} {size}" for size in SIZES]
                third = [100 * cells.visible[key] if bar.iou == FOUND else thesis(key) for key in keys]
                pairs = [_marked(network[key], baseline[key]) for key in keys]
                yield (
                    f"| {wall} | {noise} | "
                    + " | ".join(f"{pair}, {figure:.0f}" for pair, figure in zip(pairs, third, strict=True))
                    + " |"
                )
        yield from ("", summary(network, baseline), "")


def summary(network: dict[str, Score], baseline: dict[str, Score]) -> str:
    """Return the comparison as a sentence, with the mean over the cells."""
    lowest = next(iter(baseline.values())).confidence
    beaten = sum(score.f1 < ENOUGH for score in baseline.values())
    worse = [key for key, score in baseline.items() if score.f1 < ENOUGH and network[key].f1 < score.f1]
    level = sum(score.f1 < ENOUGH and network[key].f1 == score.f1 for key, score in baseline.items())
    blocks = [score.true_positives + score.false_negatives for score in network.values()]
    spread = 100 * max(math.sqrt(0.25 / max(count, 1)) for count in blocks)
    better = f"{beaten - len(worse) - level} of the {beaten} cells in which the baseline has less than 95 %"
    others = [f"level in {level}"] * bool(level) + [f"worse in {', '.join(worse)}"] * bool(worse)
    return (
        f"Mean F1 over {len(network)} cells: detector {100 * mean_f1(network):.1f} %, baseline {100 * mean_f1(baseline):.1f} % "
        f"(scores of {lowest:g} or more). The detector is better in {'; '.join([better, *others])}. "
        f"{min(blocks)} to {max(blocks)} blocks a cell; a cell's standard error is at most {spread:.1f} %."
    )


def means(every: Sequence[Cells]) -> Iterator[str]:
    """Yield lines of Markdown: means over the walls, and the components of the difference from the thesis."""
    heads = ("placement", "sensor", "size", "noise", "masks: 0.25, 0.75", "boxes: 0.25, 0.75", "baseline, masks: 0.25, 0.75")
    yield f"| {' | '.join((*heads, 'bound', 'thesis', 'lacks, points: map, found, drawn'))} |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for cells in every:
        network, baseline = [cells.network(bar) for bar in BARS], [cells.baseline(bar) for bar in BARS]
        for size in SIZES:
            for noise in LEVELS:
                keys = [f"{wall} {noise} {size}" for wall in THESIS]
                found, boxes_found, drawn, boxes_drawn = (_mean(100 * scores[key].f1 for key in keys) for scores in network)
                rival = [_mean(100 * scores[key].f1 for key in keys) for scores in (baseline[0], baseline[2])]
                bound, reference = _mean(bound_of(cells.visible[key]) for key in keys), _mean(thesis(key) for key in keys)
                reachable = min(bound, reference)
                lacks = reference - reachable, reachable - found, found - drawn
                yield (
                    f"| {cells.tested.placement} | {cells.sensors} | {size} | {noise} | {found:.0f}, {drawn:.0f} "
                    f"| {boxes_found:.0f}, {boxes_drawn:.0f} | {rival[0]:.0f}, {rival[1]:.0f} | {bound:.0f} | {reference:.0f} "
                    f"| {', '.join(f'{each:.0f}' for each in lacks)} |"
                )


def total(cells: Cells) -> str:
    """Return the means over all cells as a sentence."""
    figures = [f"{100 * mean_f1(each(bar)):.1f}" for each in (cells.network, cells.baseline) for bar in (BARS[0], BARS[2])]
    return (
        f"{cells.tested.placement}, {cells.sensors} together, mean F1 of masks at 0.25 and 0.75 over {len(cells.images)} "
        "combinations of wall, noise and size: "
        f"detector {figures[0]} and {figures[1]} %, baseline {figures[2]} and {figures[3]} %."
    )


def bound_of(share: float) -> float:
    """F1, %, of a detector that finds that share of the blocks and nothing else."""
    return 100 * 2 * share / (1 + share)


def thesis(cell: str) -> float:
    """Return the thesis's F1 of a cell, %."""
    wall, noise, size = cell.split()
    return THESIS[wall][noise][SIZES.index(size)]


def mean_f1(cells: dict[str, Score]) -> float:
    """Return the mean F1 over the cells."""
    return _mean(score.f1 for score in cells.values())


def _mean(values: Iterator[float]) -> float:
    every = list(values)
    return sum(every) / len(every)


def _marked(score: Score, rival: Score) -> str:
    text = f"{100 * score.f1:.0f}"
    return f"{f'**{text}**' if score.f1 > rival.f1 else text}, {100 * rival.f1:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=Path, required=True, action="append", dest="folders", help="what detector_test.yaml makes")
    parser.add_argument("--model", default="default", help="default, or a trained detector's folder")
    parser.add_argument("--out", default="found", help="name of the folder, beside each set's, for the detections")
    parser.add_argument("--mirrored", action="store_true", help="also look at the mirror images of the maps")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/validation")
    arguments = parser.parse_args()
    tests = [
        Tested.of(each, arguments.model, each.with_name(f"{each.name}_{arguments.out}"), mirrored=arguments.mirrored)
        for each in arguments.folders
    ]
    every = [tested.on(sensor) for tested in tests for sensor in SENSORS]
    parts = [line for cells in every for line in (f"## {cells.tested.placement}, {cells.sensors}", "", *tables(cells))]
    details, overview = (
        "\n".join(parts).rstrip(),
        "\n".join([*means(every), "", *(total(tested.on(*SENSORS)) for tested in tests)]),
    )
    print(details, overview, sep="\n\n")
    if arguments.write:
        write_between(DOCS / "detector_tables.md", MARKS, details)
        write_between(DOCS / "detector.md", MARKS, overview)


if __name__ == "__main__":
    main()

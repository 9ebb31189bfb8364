r"""Compare F1 on whole maps with that on tiles, to separate effects of tile edges from those of the detector.

    scarpsim dataset configs/datasets/detector_test.yaml --set tiles.size_px=1560 --set tiles.minimum_valid_share=0.05 \
        --set "sensors=[tls]" --set "parts.0.sizes=[large]" --set name=whole --out sets/whole
    python benchmarks/detector_whole.py --sets sets/detector_test sets/whole [--sets ...] [--write]

The epochs are those of configs/datasets/detector_test.yaml, in tiles larger than a map. Compared are cells that both sets have:
wall, noise and size of one sensor. A block that tiles cut counts once for each tile that shows part of it, a whole one once;
`detect` covers whole maps with windows that overlap by a quarter. The rest is as in detector_table.py. --write puts the table
into docs/validation/detector.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from detector_table import BARS, DOCS, SENSORS, Cells, Tested, mean_f1
from documents import write_between

from pipeline.detection.evaluation.evaluate import Score

MARKS = "<!-- whole -->", "<!-- end of whole -->"


def cells_of_both(cut: Tested, whole: Tested) -> Iterator[tuple[Cells, Cells]]:
    """Of each sensor that both sets have, those cells."""
    for sensor in SENSORS:
        pair = cut.on(sensor), whole.on(sensor)
        names = [name for name in pair[0].images if name in pair[1].images]
        if names:
            one, other = (Cells(each.tested, each.sensors, {name: each.images[name] for name in names}) for each in pair)
            yield one, other


def rows(cut: Cells, whole: Cells) -> Iterator[str]:
    """Yield the rows of the table, in Markdown."""
    both = [(cells.network(bar), cells.baseline(bar)) for bar in BARS if bar.kind == "segm" for cells in (cut, whole)]
    for name in cut.images:
        counts = [_blocks(network[name]) for network, _ in both[:2]]
        values = [f"{_f1(network[name])}, {_f1(baseline[name])}" for network, baseline in both]
        yield f"| {cut.tested.placement} | {cut.sensors} | {name} | {counts[0]}, {counts[1]} | {' | '.join(values)} |"
    means = [f"{100 * mean_f1(network):.1f}, {100 * mean_f1(baseline):.1f}" for network, baseline in both]
    yield f"| {cut.tested.placement} | {cut.sensors} | mean | | {' | '.join(means)} |"


def _blocks(score: Score) -> int:
    return score.true_positives + score.false_negatives


def _f1(score: Score) -> str:
    return f"{100 * score.f1:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=Path, nargs=2, required=True, action="append", help="tiles; whole maps of the same epochs")
    parser.add_argument("--model", default="default", help="default, or a trained detector's folder")
    parser.add_argument("--out", default="found", help="name of the folder, beside each set's, for the detections")
    parser.add_argument("--write", action="store_true", help="put the table into docs/validation/detector.md")
    arguments = parser.parse_args()
    heads = [f"masks, {bar.iou:g}: {kind}" for bar in BARS if bar.kind == "segm" for kind in ("tiles", "whole maps")]
    lines = [f"| placement | sensor | cell | blocks: tiles, whole | {' | '.join(heads)} |", "|---|---|---|---|---|---|---|---|"]
    for pair in arguments.sets:
        tests = [Tested.of(each, arguments.model, each.with_name(f"{each.name}_{arguments.out}")) for each in pair]
        for cut, whole in cells_of_both(*tests):
            lines += rows(cut, whole)
    text = "\n".join(lines)
    print(text)
    if arguments.write:
        write_between(DOCS / "detector.md", MARKS, text)


if __name__ == "__main__":
    main()

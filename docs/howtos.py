"""Carries out the how-to guides and tutorials as they are written, and keeps their pictures.

    python docs/howtos.py [PAGE ...]        such as own_site; renews the pictures in docs/images; minutes in all

A page's blocks are its steps, in order: one with a title is a file to write (a Python file is then run), one of bash holds
commands, a line each. What a page asks its reader to have is written by docs/example_data.py.
"""

from __future__ import annotations

import contextlib
import io
import re
import runpy
import shlex
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from pipeline.cli.main import main, simulate

FOLDER = Path(__file__).parent
PICTURES = {
    "own_site": "runs/stereo/difference_001.png",
    "training_set": "sets/my_set/card/samples_stereo.png",
    "compare_sensors": "comparison/detection.png",
    "calibrate": "calibration/windows.png",
    "missing_effect": "diagnosis/profiles.png",
    "raw_scan": "from_raw/understood.png",
}
"""The how-to guides, and the picture among their results that each shows."""
TUTORIALS = {
    "simulate_and_look": "",
    "two_scans_to_a_finding": "finding/maps.png",
    "detector_for_my_site": "found/other_tls_usual_all_test0001_r00000_c00512_detections.png",
    "close_the_circle": "spring/map_001.png",
}
"""The tutorials, likewise; the first shows the pictures of the demo."""
NEEDS = {
    "own_site": "site",
    "two_scans_to_a_finding": "site",
    "close_the_circle": "site",
    "missing_effect": "measurement",
    "raw_scan": "measurement",
}
"""Which example data of docs/example_data.py a page asks its reader to have."""
_BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```", re.MULTILINE | re.DOTALL)
_PROGRAMS: dict[str, Callable[[list[str]], int]] = {"scarpsim": main, "simulate": simulate}
_COLOURS, _WIDEST = 256, 1100


@dataclass(frozen=True)
class Step:
    """What a reader does at one place of a page: save `text` as `file`, or (file "") type it."""

    file: str
    text: str


def steps(page: str) -> list[Step]:
    """Return the steps of a how-to guide or tutorial: its blocks that are titled or bash."""
    folder = "tutorials" if page in TUTORIALS else "howto"
    blocks = _BLOCK.findall((FOLDER / folder / f"{page}.md").read_text(encoding="utf-8"))
    return [Step(title, text) for language, title, text in blocks if title or language == "bash"]


def carry_out(page: str, further: Mapping[str, Sequence[str]] | None = None) -> str:
    """Do a page's steps in the current folder; returns what the commands print.

    further: words to add to each command, by its first words, such as "scarpsim inspect". Raises RuntimeError where one fails.
    """
    printed = io.StringIO()
    for step in steps(page):
        with contextlib.redirect_stdout(printed):
            if step.file:
                Path(step.file).write_text(step.text, encoding="utf-8")
            if step.file.endswith(".py"):
                runpy.run_path(step.file)
            for line in () if step.file else step.text.splitlines():
                _command(line, further or {})
    return printed.getvalue()


def _command(line: str, further: Mapping[str, Sequence[str]]) -> None:
    program, *words = shlex.split(line)
    added = [word for start, extra in further.items() if line.startswith(start) for word in extra]
    code = _PROGRAMS[program]([*words, *added])
    if code != 0:
        raise RuntimeError(f"exit code {code}: {line}")


def _renew(page: str) -> None:
    import example_data

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        if NEEDS.get(page) == "site":
            example_data.site(Path())
        if NEEDS.get(page) == "measurement":
            example_data.measurement(Path("my_measurement"))
        sys.stderr.write(f"== {page}\n{carry_out(page)}\n")
        if not (shown := (PICTURES | TUTORIALS)[page]):
            return
        with Image.open(shown) as picture:
            picture.thumbnail((_WIDEST, _WIDEST))
            small = picture.convert("RGB").quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        kind = "tutorial" if page in TUTORIALS else "howto"
        small.save(FOLDER / "images" / f"{kind}_{page}.png", optimize=True)


if __name__ == "__main__":
    for name in sys.argv[1:] or (*PICTURES, *TUTORIALS):
        _renew(name)

"""Likely mistakes and what scarpsim answers: `python docs/make_mistakes.py` tries each and writes docs/reference/mistakes.md.

tests/test_mistakes.py tries them too, against the page.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from pipeline.cli import main as cli

PAGE = Path(__file__).parent / "reference" / "mistakes.md"
SITE = """seed: 1
wall: {style: glendale, width_m: 6, height_m: 4, resolution_m: 0.1, seed: 1}
rockfall: {count: 3, size_m: 0.4}
cameras: {distance_m: 20, base_m: 5}
depth_map: low
station: {distance_m: 20}
scanner: {azimuth_step_rad: 0.004, zenith_step_rad: 0.004}
difference: {gsd_m: 0.05}
"""
TLS = "simulate --sensor tls --config site.yaml --out out"
STEREO = "simulate --sensor stereo --config site.yaml --out out"


@dataclass(frozen=True)
class Mistake:
    """A command that cannot be right. section: of the page; what: in words; words: of the command line."""

    section: str
    what: str
    words: tuple[str, ...]

    @property
    def command(self) -> str:
        """As a person types it."""
        quoted = (f"'{word}'" if set(word) & set("{}[]|& ") else word for word in self.words)
        script = "" if self.words[0] == "simulate" else "scarpsim "
        return script + " ".join(quoted).replace("--config site.yaml --out out ", "... ").replace(
            "--config site.yaml --out out", "..."
        )


def _set(section: str, what: str, *overrides: str, start: str = TLS) -> Mistake:
    return Mistake(section, what, (*start.split(), *(word for each in overrides for word in ("--set", each))))


def _run(section: str, what: str, command: str) -> Mistake:
    return Mistake(section, what, tuple(command.split()))


KEYS, VALUES, SENSORS, FILES, OUTPUT, COMMANDS = "Keys", "Values", "Sensors and walls", "Input files", "Output", "Commands"
MISTAKES = (
    _set(KEYS, "a misspelt section", "rockfal.count=3"),
    _set(KEYS, "a misspelt key", "rockfall.cuont=3"),
    _set(KEYS, "a misspelt preset", "scanner.presett=riegl_vz400i"),
    _set(KEYS, "a parameter of another effect", "sensor={sensor: tls, effects: [{name: range_offset, scale_ppm: 10}]}"),
    _set(KEYS, "noise of the other sensor", "sensor={sensor: tls, noise: {parallax_sigma_px: 0.3}}"),
    _set(KEYS, "keys of two kinds of wall", "wall={mesh: wall.ply, style: glendale}"),
    _set(KEYS, "a key without a value", "wall.style"),
    _set(VALUES, "a word instead of a number", "scanner.azimuth_step_rad=fast"),
    _set(VALUES, "a number that is too small", "rockfall.count=0"),
    _set(VALUES, "a fraction instead of a count", "rockfall.count=2.5"),
    _set(VALUES, "a negative noise", "sensor={sensor: tls, noise: {range_sigma_m: -1}}"),
    _set(VALUES, "wrong upper or lower case", "depth_map=Medium"),
    _set(VALUES, "an unknown style of wall", "wall.style=Glendal"),
    _set(VALUES, "an unknown distribution", "rockfall.size_m={kind: gausian, mean: 1, sigma: 0.1}"),
    _set(VALUES, "degrees instead of radians: a slope", "wall.slope_rad=70"),
    _set(VALUES, "degrees instead of radians: a field of view", "scanner.zenith_limits_rad=[30, 130]"),
    _set(VALUES, "degrees instead of radians: a step", "scanner.zenith_step_rad=0.04"),
    _set(VALUES, "millimetres instead of metres: a focal length", "cameras.focal_length_m=50", start=STEREO),
    _set(VALUES, "an unknown effect", "sensor={sensor: tls, effects: [{name: range_ofset, offset_m: 0.01}]}"),
    _set(VALUES, "a misspelt parameter of an effect", "sensor={sensor: tls, effects: [{name: range_offset, offset: 0.004}]}"),
    _set(VALUES, "an unknown scanner", "scanner.preset=riegl_vz40"),
    _set(VALUES, "the model of the other sensor", "sensor={sensor: stereo}"),
    _set(SENSORS, "a sensor behind the wall", "station.position_m=[3, 20, 1]"),
    _set(SENSORS, "a sensor underground", "station.position_m=[3, -20, -60]"),
    _set(SENSORS, "a mirrored pose", "station={position_m: [3, -20, 1], rotation: [[0, 1, 0], [1, 0, 0], [0, 0, 1]]}"),
    _set(SENSORS, "a sensor out of range", "scanner.maximum_range_m=5"),
    _set(SENSORS, "cameras whose pictures do not overlap", "cameras.base_m=500", start=STEREO),
    _set(SENSORS, "blocks larger than the wall", "rockfall.size_m=50"),
    _set(SENSORS, "more blocks than fit on the wall", "rockfall.count=300"),
    _set(SENSORS, "a safe zone that leaves no wall", "rockfall.safe_zone_offset_m=100"),
    _set(SENSORS, "pixels larger than the wall", "difference.gsd_m=50"),
    _set(SENSORS, "pixels too small for any computer", "difference.gsd_m=0.00001"),
    _set(FILES, "a mesh that does not exist", "wall={mesh: none.ply}"),
    _set(FILES, "NaN in a mesh", "wall={mesh: nan.ply}"),
    _set(FILES, "a mesh in millimetres", "wall={mesh: mm.ply}"),
    _set(FILES, "a truncated mesh", "wall={mesh: cut.ply}"),
    _set(FILES, "a mesh in an unknown format", "wall={mesh: site.yaml}"),
    _set(FILES, "an unreadable XML", "cameras=cut.xml", start=STEREO),
    _run(FILES, "a config that does not exist", "simulate --sensor tls --config none.yaml"),
    _run(FILES, "a file that is not a config", "simulate --sensor tls --config wall.ply"),
    _run(FILES, "a config with tabs", "simulate --sensor tls --config tabs.yaml"),
    _run(FILES, "the same key twice", "simulate --sensor tls --config twice.yaml"),
    _run(FILES, "a config that tries to run a program", "simulate --sensor tls --config tag.yaml"),
    _run(FILES, "a folder without a measurement", "gap used"),
    _run(FILES, "a folder without a difference map", "detect baseline used"),
    _run(OUTPUT, "an output folder that is a file", "simulate --sensor tls --config site.yaml --out file"),
    _run(OUTPUT, "an output folder in use", "simulate --sensor tls --config site.yaml --out used"),
    _run(OUTPUT, "nothing to resume", "simulate --sensor tls --config site.yaml --out used --resume"),
    _run(OUTPUT, "a place that cannot be written", "simulate --sensor tls --config site.yaml --out /proc/run"),
    _run(OUTPUT, "resuming with another seed", "simulate --sensor tls --config mesh.yaml --out begun --resume --seed 5"),
    _run(OUTPUT, "resuming after the mesh was replaced", "simulate --sensor tls --config mesh.yaml --out begun --resume"),
    _run(OUTPUT, "a config that init would overwrite", "init --out site.yaml"),
    _run(COMMANDS, "an unknown command", "simulat --sensor tls"),
    _run(COMMANDS, "an unknown flag", "simulate --senser tls"),
    _run(COMMANDS, "an unknown sensor", "simulate --sensor lidar"),
    _run(COMMANDS, "a percentage instead of a share", "detect baseline used --confidence 95"),
    _run(COMMANDS, "a folder without results", "view used"),
)


@contextlib.contextmanager
def playground() -> Iterator[None]:
    """Yield a temporary folder with the files that the mistakes name, as the working folder."""
    before, place = Path.cwd(), Path(tempfile.mkdtemp(prefix="scarpsim_mistakes_"))
    os.chdir(place)
    try:
        _make_files()
        yield
    finally:
        os.chdir(before)
        shutil.rmtree(place)


def answer(mistake: Mistake) -> tuple[int, str, str]:
    """Exit code, what was on stdout, and the message on stderr without progress, with paths as in the working folder."""
    shutil.rmtree("out", ignore_errors=True)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([*mistake.words, "--quiet"] if mistake.words[0] == "simulate" else list(mistake.words))
    return code, out.getvalue(), err.getvalue().strip().replace(f"{Path.cwd()}/", "")


def page(answers: dict[Mistake, str]) -> str:
    """docs/reference/mistakes.md."""
    head = """# Common mistakes

This page is for users who got an error message and want to know what caused it. It shows common mistakes and their messages:
look for yours by its words, or by the part of the program that it names. In each box the first line is the command, and the
second the message. A message says where the mistake is, what is wrong ("got" is your value), what is allowed, and what to do.

A mistake ends the command with exit status 2 and leaves no half-written results. `...` stands for `--config site.yaml --out out`,
a small site.

`python docs/make_mistakes.py` writes this page, and the tests try every command on it.
"""
    parts = [head]
    for section in dict.fromkeys(mistake.section for mistake in answers):
        parts.append(f"\n## {section}\n")
        for mistake, message in answers.items():
            if mistake.section == section:
                parts.append(f"\n**{mistake.what}**\n\n```text\n$ {mistake.command}\n{message}\n```\n")
    return "".join(parts)


def _make_files() -> None:
    Path("site.yaml").write_text(SITE)
    vertices, faces = _wall()
    bad = vertices.copy()
    bad[5, 1] = np.nan
    for name, corners in (("wall", vertices), ("nan", bad), ("mm", vertices * 1000)):
        trimesh.Trimesh(corners, faces, process=False).export(f"{name}.ply")
    whole = Path("wall.ply").read_bytes()
    Path("cut.ply").write_bytes(whole[: len(whole) // 2])
    Path("cut.xml").write_text("<document><chunk>")
    Path("tabs.yaml").write_text("wall:\n\tstyle: glendale\n")
    Path("twice.yaml").write_text("seed: 1\nseed: 2\n")
    Path("tag.yaml").write_text('seed: !!python/object/apply:os.system ["touch harm"]\n')
    Path("file").write_text("")
    Path("used").mkdir()
    Path("used/mine.txt").write_text("")
    _make_begun(vertices, faces)


def _make_begun(vertices: Any, faces: Any) -> None:
    """Make a run on a mesh that was then replaced by another of the same name."""
    trimesh.Trimesh(vertices, faces, process=False).export("survey.ply")
    lines = ["wall: {mesh: survey.ply}" if line.startswith("wall:") else line for line in SITE.splitlines()]
    Path("mesh.yaml").write_text("\n".join(lines))
    with contextlib.redirect_stdout(io.StringIO()):
        code = cli.main(["simulate", "--sensor", "tls", "--config", "mesh.yaml", "--out", "begun", "--quiet"])
    assert code == 0
    trimesh.Trimesh(vertices * 1.01, faces, process=False).export("survey.ply")


def _wall() -> tuple[Any, Any]:
    """Return a wavy wall of 5.7 x 4.2 m: vertices and faces."""
    columns, rows = 20, 15
    x, z = (axis.ravel() for axis in np.meshgrid(0.3 * np.arange(columns), 0.3 * np.arange(rows), indexing="ij"))
    at = np.arange(columns * rows).reshape(columns, rows)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    return np.stack([x, 0.1 * np.sin(x), z], axis=1), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


if __name__ == "__main__":
    with playground():
        found = {mistake: answer(mistake) for mistake in MISTAKES}
    PAGE.write_text(page({mistake: message for mistake, (_, _, message) in found.items()}), encoding="utf-8")

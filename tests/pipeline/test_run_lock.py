"""A run folder has one writer; a finished part is complete or made again; other files beside it stay."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pictures import ENVIRONMENT
from pictures import command as started
from test_run import config, digests

from pipeline.cli.main import simulate as command
from pipeline.formats.files import atomic
from pipeline.formats.files.atomic import write_bytes
from pipeline.formats.files.lock import LOCK, locked
from pipeline.run import simulation as pipeline_run
from pipeline.run.products import is_whole
from pipeline.run.simulation import simulate
from scene.common.errors import InputError

pytestmark = pytest.mark.usefixtures("undrawn")

ROOT = Path(__file__).parents[2]
COARSE: dict[str, Any] = {
    "wall": {"style": "glendale", "width_m": 8.0, "height_m": 5.0, "resolution_m": 0.1, "seed": 1},
    "scanner": {"azimuth_step_rad": 0.003, "zenith_step_rad": 0.003},
    "difference": {"gsd_m": 0.05},
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "tls"
    simulate(config(**COARSE), "tls", out)
    return out


def copied(folder: Path, to: Path) -> Path:
    subprocess.run(["cp", "-r", str(folder), str(to)], check=True)
    return to


def test_a_run_is_not_resumed_while_it_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is it started a second time; and the running one ends as if nobody had tried."""
    out, answers = tmp_path / "run", []
    real = pipeline_run.observe_epoch

    def meanwhile(*arguments: Any) -> Any:
        for resume in (True, False):
            with pytest.raises(InputError, match=rf"in use by process {os.getpid()} on .*wait for that process") as caught:
                simulate(config(**COARSE), "tls", out, resume=resume)
            answers.append(caught.value)
        return real(*arguments)

    monkeypatch.setattr(pipeline_run, "observe_epoch", meanwhile)
    simulate(config(**COARSE), "tls", out)
    assert len(answers) == 2
    present = {path.name for path in (out / "epoch_001").iterdir()}
    assert {"points.laz", "surface.ply", "truth.ply", "blocks.json", "epoch.json"} <= present
    assert not list(out.rglob(".*"))


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_stands_where_the_lock_should_is_refused_and_stays(make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / LOCK)
    with pytest.raises(InputError, match="is not a file"), locked(tmp_path):
        pass
    assert (tmp_path / LOCK).exists()


def test_the_lock_goes_with_its_process(tmp_path: Path) -> None:
    """A killed process leaves the lock's file, but nobody holds the lock."""
    program = (
        "import sys, pathlib, os; from pipeline.formats.files.lock import locked\n"
        "with locked(pathlib.Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "run")],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=rf"in use by process {process.pid} "), locked(tmp_path / "run"):
        pass
    process.kill()
    process.wait()
    assert (tmp_path / "run" / LOCK).exists()
    with locked(tmp_path / "run"):
        pass
    assert list((tmp_path / "run").iterdir()) == []


@pytest.mark.parametrize(
    "moments", [(".epoch_000/points.laz",), (".epoch_000/points.laz", "difference_001.tif")], ids=["once", "twice"]
)
def test_a_run_that_is_killed_goes_on_to_the_same_bytes(moments: tuple[str, ...], finished: Path, tmp_path: Path) -> None:
    """The command gets kill -9 in the middle of the reference epoch, and its successor among the maps."""
    out, coarse = tmp_path / "run", tmp_path / "coarse.yaml"
    coarse.write_text(json.dumps(config(**COARSE).model_dump(mode="json")))
    words = ["--sensor", "tls", "--config", str(coarse), "--out", str(out), "--quiet"]
    for moment in moments:
        process = subprocess.Popen(
            started("simulate", *words, *(["--resume"] if (out / "run.json").exists() else [])), env=ENVIRONMENT
        )
        while not (out / moment).exists():
            assert process.poll() is None
            time.sleep(0.001)
        process.kill()
        process.wait()
    simulate(config(**COARSE), "tls", out, resume=True)
    assert digests(out) == digests(finished)
    assert not list(out.rglob(".*"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES: dict[str, Callable[[Path], None]] = {
    "difference_001.tif": Path.unlink,
    "epoch_001/points.laz": lambda path: path.write_bytes(b"") and None,
    "epoch_001/epoch.json": cut,
    "epoch_000/truth.ply": cut,
    "reference.png": Path.unlink,
    "epoch_001/blocks.json": lambda path: path.write_text(path.read_text().replace("1", "2", 1)) and None,
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_seen(name: str, finished: Path, tmp_path: Path) -> None:
    out = copied(finished, tmp_path / "run")
    products = json.loads((out / "run.json").read_text())["products"]
    assert list(products) == ["epoch_000", "epoch_001"]
    assert [is_whole(out, checksums, out) for checksums in products.values()] == [True, True]
    DAMAGES[name](out / name)
    assert sorted(is_whole(out, checksums, out) for checksums in products.values()) == [False, True]


def test_what_is_missing_or_damaged_is_made_again(finished: Path, tmp_path: Path) -> None:
    out = copied(finished, tmp_path / "run")
    for name, damage in DAMAGES.items():
        damage(out / name)
    (out / "epoch_001/notes.txt").write_text("mine")
    simulate(config(**COARSE), "tls", out, resume=True)
    assert (out / "epoch_001/notes.txt").read_text() == "mine"
    (out / "epoch_001/notes.txt").unlink()
    assert digests(out) == digests(finished)


def test_a_folder_in_the_place_of_a_product_is_named(finished: Path, tmp_path: Path) -> None:
    out = copied(finished, tmp_path / "run")
    (out / "difference_001.tif").unlink()
    (out / "difference_001.tif").mkdir()
    with pytest.raises(InputError, match=r"difference_001.tif: the path cannot be a file \(Is a directory\)"):
        simulate(config(**COARSE), "tls", out, resume=True)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"products": {"epoch_001": 3}}'])
def test_a_damaged_record_of_the_run_is_named(text: str, finished: Path, tmp_path: Path) -> None:
    out = copied(finished, tmp_path / "run")
    found = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(found | json.loads(text)) if "products" in text else text)
    with pytest.raises(InputError, match=r"run\.json"):
        simulate(config(**COARSE), "tls", out, resume=True)


def test_names_in_the_record_stay_in_the_folder(finished: Path, tmp_path: Path) -> None:
    out = copied(finished, tmp_path / "run")
    found = json.loads((out / "run.json").read_text())
    found["products"]["epoch_001"]["../../elsewhere"] = "0"
    (out / "run.json").write_text(json.dumps(found))
    with pytest.raises(InputError, match="lies outside of its folder"):
        simulate(config(**COARSE), "tls", out, resume=True)


def test_an_interrupt_while_a_resumed_run_builds_its_wall(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = copied(finished, tmp_path / "run")

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline_run, "prepare_site", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate(config(**COARSE), "tls", out, resume=True)
    assert digests(out) == digests(finished)


def test_an_error_takes_only_what_the_run_wrote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"

    def fails(*_: Any) -> Any:
        (out / "notes.txt").write_text("mine")
        (out / "epoch_000/photo.jpg").write_text("mine")
        raise InputError("the blocks find no room")

    monkeypatch.setattr(pipeline_run, "observe_epoch", fails)
    with pytest.raises(InputError, match="no room"):
        simulate(config(**COARSE), "tls", out)
    left = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert left == {"notes.txt", "epoch_000/photo.jpg"}


@pytest.mark.parametrize("kind", ["here", "link", "empty"])
def test_an_error_is_one_line_whatever_the_folder_is(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`.`, a link and an existing folder (like a mount point) remain, empty."""
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "link").symlink_to(folder)
    monkeypatch.chdir(folder)
    out = {"here": ".", "link": str(tmp_path / "link"), "empty": str(folder)}[kind]
    coarse = tmp_path / "coarse.yaml"
    coarse.write_text(json.dumps(config(**COARSE, rockfall={"count": 5, "size_m": 20.0}).model_dump(mode="json")))
    assert command(["--sensor", "tls", "--config", str(coarse), "--out", out, "--quiet"]) == 2
    error = capsys.readouterr().err.strip()
    assert "larger than the wall" in error
    assert "\n" not in error
    assert list(folder.iterdir()) == []


def test_bytes_are_on_the_disk_before_the_name_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[tuple[str, str]] = []
    fsync, replace = os.fsync, Path.replace

    def noted_fsync(file: int) -> None:
        done.append(("fsync", Path(f"/proc/self/fd/{file}").readlink().name))
        fsync(file)

    def noted_replace(path: Path, target: Path) -> Path:
        done.append(("rename", target.name))
        return replace(path, target)

    monkeypatch.setattr(atomic.os, "fsync", noted_fsync)
    monkeypatch.setattr(Path, "replace", noted_replace)
    write_bytes(tmp_path / "a.bin", b"whole")
    assert done == [("fsync", ".a.part.bin"), ("rename", "a.bin"), ("fsync", tmp_path.name)]

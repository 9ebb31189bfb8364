"""The command line: exit codes, one line per mistake, and what reaches the pipeline. The pipeline itself is a stand-in here."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from pipeline.cli import main as cli
from pipeline.cli.simulate import new_folder
from scene.config import Config
from scene.errors import InputError


class Pipeline:
    """Stands in for pipeline.config and pipeline.run: keeps what it was called with, raises what it is told to."""

    def __init__(self) -> None:
        self.loaded: tuple[Any, ...] = ()
        self.ran: tuple[Any, ...] = ()
        self.error: BaseException | None = None

    def load_config(self, *arguments: Any) -> str:
        self.loaded = arguments
        return "config"

    def simulate(self, *arguments: Any, resume: bool, progress: Any) -> SimpleNamespace:
        self.ran = (*arguments, resume)
        with progress.stage("wall"):
            if self.error:
                raise self.error
        return SimpleNamespace(report=arguments[2] / "report.html")


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Pipeline:
    fake = Pipeline()
    for name, function in (("config", fake.load_config), ("run", fake.simulate)):
        module = ModuleType(f"pipeline.{name}")
        setattr(module, function.__name__, function)
        monkeypatch.setitem(sys.modules, f"pipeline.{name}", module)
        monkeypatch.setattr("pipeline." + name, module, raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.yaml").touch()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return fake


SIMULATE = ["simulate", "--sensor", "tls", "--config", "my.yaml", "--out", "here"]


def test_simulate_hands_everything_on(pipeline: Pipeline, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SIMULATE, "--seed", "7", "--set", "a.b=1", "--set", "c=[2]", "--resume"]) == 0
    assert pipeline.loaded == (Path("my.yaml"), ["a.b=1", "c=[2]"], "tls", 7)
    assert pipeline.ran == ("config", "tls", Path("here"), True)
    assert capsys.readouterr().out == "report: here/report.html\n"


def test_both_scripts_are_the_same_command(pipeline: Pipeline) -> None:
    assert cli.simulate(SIMULATE[1:]) == 0
    assert pipeline.ran == ("config", "tls", Path("here"), False)


def test_results_go_to_a_new_folder_each_time(pipeline: Pipeline, tmp_path: Path) -> None:
    first = new_folder(tmp_path, "tls")
    first.mkdir()
    assert new_folder(tmp_path, "tls") != first
    assert cli.main(["simulate", "--sensor", "stereo", "--config", "my.yaml"]) == 0
    assert pipeline.ran[2].parent == Path("runs")
    assert pipeline.ran[2].name.startswith("stereo_")


MISTAKES = [
    (["simulat"], "did you mean 'simulate'?"),
    (
        ["frobnicate"],
        "allowed: simulate, inspect, compare, icp-study, calibrate, dataset, gap, train, detect, evaluate, init, doctor",
    ),
    (["--versio"], "did you mean '--version'?"),
    (["simulate"], "required: --sensor"),
    (["simulate", "--senser", "tls"], "unknown option '--senser'; did you mean '--sensor'?"),
    (["simulate", "--sens", "tls"], "did you mean '--sensor'?"),
    (["simulate", "--sensor", "TLS"], "did you mean 'tls'?"),
    (["simulate", "--sensor", "lidar"], "allowed: stereo, tls"),
    (["simulate", "--sensor"], "expected one argument"),
    ([*SIMULATE, "--seed", "three"], "allowed: a whole number from 0"),
    ([*SIMULATE, "--seed", "-1"], "allowed: a whole number from 0"),
    ([*SIMULATE, "--threads", "0"], "allowed: a whole number from 1"),
    ([*SIMULATE, "more.yaml"], "unexpected argument 'more.yaml'"),
    (["simulate", "--sensor", "tls", "--resume"], "add --out DIR"),
    (["doctor", "--jsno"], "did you mean '--json'?"),
]


@pytest.mark.parametrize(("words", "expected"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_is_one_line_and_exit_2(
    words: list[str], expected: str, pipeline: Pipeline, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("error: ")
    assert output.err.count("\n") == 1
    assert expected in output.err
    assert pipeline.ran == ()


@pytest.mark.parametrize(
    ("error", "code", "expected"),
    [
        (
            InputError("negative", where="step_rad", remedy="use a positive one"),
            2,
            "error: step_rad: negative; use a positive one",
        ),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "x.laz"), 2, "error: x.laz: No space left on device; make room"),
        (PermissionError(errno.EACCES, "Permission denied", "here"), 2, "error: here: Permission denied; check the permissions"),
        (KeyboardInterrupt(), 130, "error: interrupted; what was finished is in here and usable; go on with --resume --out here"),
        (ImportError("libGL.so.1"), 1, "`scarpsim doctor` says what is missing"),
        (RuntimeError("two\nlines"), 1, "RuntimeError: two lines; the traceback is in "),
    ],
)
def test_every_error_becomes_a_line_and_a_code(
    error: BaseException, code: int, expected: str, pipeline: Pipeline, capsys: pytest.CaptureFixture[str]
) -> None:
    pipeline.error = error
    assert cli.main(SIMULATE) == code
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1


def test_the_traceback_of_a_fault_is_kept(pipeline: Pipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pipeline.error = RuntimeError("strange")
    cli.main(SIMULATE)
    (file,) = tmp_path.glob("scarpsim_error_*.txt")
    assert "Traceback" in file.read_text()
    assert str(file) in capsys.readouterr().err
    cli.main([*SIMULATE, "--debug"])
    assert "Traceback" in capsys.readouterr().err


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert cli.main(["--version"]) == 0
    for words in (["--help"], *([name, "--help"] for name in cli.COMMANDS)):
        assert cli.main(words) == 0
        assert "example:\n  " in capsys.readouterr().out


class Toy(Config):
    """A toy."""

    seed: int = 3


def test_init_writes_once(
    pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for kind, name in (("", "demo"), ("sites", "glendale")):
        (tmp_path / "configs" / kind).mkdir(parents=True, exist_ok=True)
        (tmp_path / "configs" / kind / f"{name}.yaml").touch()
    monkeypatch.setattr("pipeline.bundled._PLACES", (tmp_path / "configs",))
    monkeypatch.setattr(sys.modules["pipeline.config"], "SimulationConfig", Toy, raising=False)
    assert cli.main(["init", "--site", "glendale", "--out", "site.yaml"]) == 0
    assert Path("site.yaml").read_text() == "# A toy.\n\nseed: 3\n"
    capsys.readouterr()
    for words, expected in (
        (["--out", "site.yaml"], "site.yaml: exists already; choose another name"),
        (["--out", "none/site.yaml"], "none: there is no such folder"),
        (["--site", "glendal"], "configs/sites: there is no 'glendal'; allowed: glendale; did you mean 'glendale'?"),
        (["--site", "../demo"], "there is no '../demo'"),
    ):
        assert cli.main(["init", *words]) == 2
        assert expected in capsys.readouterr().err
    assert "seed: 3" in Path("site.yaml").read_text()

"""The command line: exit codes, one line per mistake, and the arguments that reach the pipeline, which is a fake here."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import example_data
import jsonschema
import numpy as np
import pytest

from pipeline.cli import main as cli
from pipeline.cli.command_output import as_json
from pipeline.cli.json_schema import json_schema
from pipeline.config.presets import read_preset
from pipeline.config.simulation import CamerasFile, load_config
from pipeline.dataset.config import load_dataset_config
from pipeline.formats.files.atomic import new_folder
from pipeline.run.site import prepare_site
from scene.common.config import load_yaml
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom


class Pipeline:
    """A fake of pipeline.config.simulation and pipeline.run.simulation: keeps its arguments and raises a given error."""

    def __init__(self) -> None:
        self.loaded: tuple[Any, ...] = ()
        self.ran: tuple[Any, ...] = ()
        self.error: BaseException | None = None
        self.words = ""
        self.notes: tuple[str, ...] = ()

    def load_config(self, *arguments: Any) -> str:
        self.loaded = arguments
        return "config"

    def simulate(self, *arguments: Any, resume: bool, progress: Any) -> SimpleNamespace:
        self.ran = (*arguments, resume)
        if self.words:
            sys.stdout.write(self.words)
        with progress.stage("wall"):
            if self.error:
                raise self.error
        return SimpleNamespace(report=arguments[2] / "report.html", notes=self.notes)


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Pipeline:
    fake = Pipeline()
    for name, function in (("config", fake.load_config), ("run", fake.simulate)):
        module = ModuleType(f"pipeline.{name}.simulation")
        setattr(module, function.__name__, function)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(import_module(f"pipeline.{name}"), "simulation", module, raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.yaml").touch()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return fake


SIMULATE = ["simulate", "--sensor", "tls", "--config", "my.yaml", "--out", "here"]


def test_simulate_prints_what_the_user_should_check(pipeline: Pipeline, capsys: pytest.CaptureFixture[str]) -> None:
    pipeline.notes = ("wall: all 2 triangles turned",)
    assert cli.main(SIMULATE) == 0
    assert capsys.readouterr().out == "note: wall: all 2 triangles turned\nreport: here/report.html\n"


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
        "allowed: simulate, inspect, compare, icp-study, calibrate, dataset, monitor, measurement, gap, train, detect, evaluate, "
        "view, export, surface, init, schema, completion, doctor",
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
    (["completion", "powershell"], "allowed: bash, zsh, fish"),
    (["schema", "simulatoin"], "did you mean 'simulation'?"),
    ([*SIMULATE, "more.yaml"], "unexpected argument 'more.yaml'; give the config as --config more.yaml"),
    ([*SIMULATE, "more.txt"], "unexpected argument 'more.txt'; see scarpsim simulate --help"),
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
        (KeyboardInterrupt(), 130, "interrupted; finished epochs are in here and usable; continue with --resume --out here"),
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


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        (["--site", "glendale", "--scanner", "riegl_vz400i"], "simulation"),
        (["--scanner", "leica_p50"], "simulation"),
        (["--dataset", "small"], "dataset"),
    ],
)
def test_init_writes_a_config_that_loads_and_its_schema(words: list[str], kind: str, tmp_path: Path) -> None:
    out = tmp_path / "mine.yaml"
    assert cli.main(["init", *words, "--out", str(out)]) == 0
    assert out.read_text().startswith(f"# yaml-language-server: $schema=scarpsim.{kind}.schema.json\n")
    schema = json.loads((tmp_path / f"scarpsim.{kind}.schema.json").read_text())
    jsonschema.validate(load_yaml(out), schema)
    if kind == "simulation":
        config = load_config(out, [], "tls", None)
        preset = read_preset(words[-1])
        assert config.tls_model() == preset.model()
        assert config.scanner.name == preset.name
    else:
        assert load_dataset_config(out).walls


def test_init_names_the_files_of_an_own_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The names are relative to the config's folder, and simulate reads them from there."""
    example_data.site(tmp_path / "data", resolution_m=0.5)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plans").mkdir()
    words = ["--mesh", "data/wall.ply", "--cameras", "data/cameras.xml", "--scanner", "riegl_vz400i", "--out", "plans/site.yaml"]
    assert cli.main(["init", *words]) == 0
    held = load_yaml(tmp_path / "plans" / "site.yaml")
    assert held["wall"] == {"mesh": "../data/wall.ply"}
    config = load_config(Path("plans/site.yaml"), [], None, None)
    assert isinstance(config.cameras, CamerasFile)
    assert config.cameras.pair().left.width > 0
    assert prepare_site(config, "stereo", KeyedRandom(1)).name == "wall"
    assert cli.main(["init", "--mesh", "nothing.ply", "--out", "other.yaml"]) == 2


def test_init_writes_once(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["init", "--out", "site.yaml"]) == 0
    before = Path("site.yaml").read_text()
    capsys.readouterr()
    for words, expected in (
        (["--out", "site.yaml"], "site.yaml: the file exists already; choose another name"),
        (["--out", "none/site.yaml"], "none: there is no such folder"),
        (["--site", "glendal"], "configs/sites: there is no bundled config 'glendal'; allowed: bismantova,"),
        (["--site", "../demo"], "there is no bundled config '../demo'"),
        (["--scanner", "riegl_vz400"], "exists already"),
        (["--scanner", "riegl"], "configs/scanners: there is no bundled config 'riegl'"),
        (["--dataset", "small", "--site", "glendale"], "--dataset: the option cannot be combined with --site"),
    ):
        assert cli.main(["init", "--out", "site.yaml", *words]) == 2
        assert expected in capsys.readouterr().err
    assert Path("site.yaml").read_text() == before


CONFIGS = Path(__file__).parents[2] / "configs"
KINDS = {"sites": "simulation", "datasets": "dataset", "detectors": "detector", "scanners": "scanner", "noise": "model"}


@pytest.mark.parametrize("folder", KINDS)
def test_the_schemas_accept_what_comes_with_the_program(folder: str) -> None:
    check = jsonschema.Draft202012Validator(json_schema(KINDS[folder]))
    check.check_schema(check.schema)
    files = sorted((CONFIGS / folder).glob("*.yaml"))
    assert files
    assert {file.name: [error.message for error in check.iter_errors(load_yaml(file))] for file in files} == {
        file.name: [] for file in files
    }


def test_the_schema_marks_mistakes() -> None:
    check = jsonschema.Draft202012Validator(json_schema("simulation"))
    for wrong in (
        {"seeed": 1},
        {"epochs": 0},
        {"depth_map": "best"},
        {"scanner": {"azimuth_step": 1}},
        {"wall": {"style": "alps"}},
    ):
        assert not check.is_valid(wrong), wrong
    for right in ({}, {"scanner": "riegl_vz400i"}, {"scanner": {"preset": "riegl_vz400i", "faces": 2}}, {"sensor": "sgbm"}):
        assert check.is_valid(right), right


def test_scripts_get_one_document(pipeline: Pipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """With --json the output is one JSON document, also if a library prints something, and for an error."""
    (tmp_path / "here").mkdir()
    (tmp_path / "here/run.json").write_text('{"schema": 1, "config": {"long": 1}, "epochs": [{"points": 5}]}')
    pipeline.words = "from a library"
    assert cli.main([*SIMULATE, "--json"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out) == {
        "folder": "here",
        "report": "here/report.html",
        "schema": 1,
        "epochs": [{"points": 5}],
    }
    assert "from a library" in output.err
    pipeline.error = InputError("negative", where="step_rad", remedy="use a positive one")
    assert cli.main([*SIMULATE, "--json"]) == 2
    assert json.loads(capsys.readouterr().out) == {"error": "step_rad: negative; use a positive one", "exit_status": 2}
    assert cli.main(["simulate", "--json", "--sens", "tls"]) == 2
    assert json.loads(capsys.readouterr().out)["exit_status"] == 2


def test_documents_hold_no_nan() -> None:
    assert json.loads(as_json({"a": float("nan"), "b": [np.float32(2.0), np.array([1.0, np.inf])], "c": Path("x")})) == {
        "a": None,
        "b": [2.0, [1.0, None]],
        "c": "x",
    }


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_options_and_words(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(word in script for word in (*cli.COMMANDS, "icp-study", "no-greedy", "stereo", "resume"))
    if shutil.which(shell):  # the shells' own check of the grammar
        subprocess.run([shell, "-n"], input=script, text=True, check=True)


def test_bash_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["completion", "bash"]) == 0
    script = tmp_path / "completion.bash"
    script.write_text(capsys.readouterr().out)
    ask = 'COMP_WORDS=(scarpsim simulate --sensor ""); COMP_CWORD=3; _shtab_scarpsim; echo "${COMPREPLY[@]}"'
    shown = subprocess.run(["bash", "-c", f"source {script}; {ask}"], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["stereo", "tls"]


def test_help_imports_nothing_heavy() -> None:
    """--help starts fast: it imports only the standard library and our modules (`benchmarks/startup.py` measures the time)."""
    program = (
        "import sys; from pipeline.cli.main import main; main(['--help']); main(['simulate', '--help']); print(*sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in shown.stdout.splitlines()[-1].split()}
    assert {"pipeline", "scene"} <= loaded
    assert loaded & {"numpy", "pydantic", "yaml", "scipy", "matplotlib", "mitsuba", "shtab", "dash", "plotly", "rich"} == set()


def test_a_simulation_starts_without_the_libraries_of_its_products() -> None:
    """Pictures, reports and point files are written late, so their libraries are loaded late (see `benchmarks/startup.py`)."""
    program = "import sys, pipeline.run.simulation; print(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in shown.stdout.split()}
    assert "mitsuba" in loaded
    assert loaded & {"matplotlib", "PIL", "laspy", "pyproj", "jinja2", "pye57", "scipy", "trimesh", "open3d"} == set()


def test_a_surface_from_points_needs_no_ray_tracer() -> None:
    program = "import sys, pipeline.formats.points.points, pipeline.surface.from_cloud; print(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in shown.stdout.split()}
    assert "numpy" in loaded
    assert loaded & {"mitsuba", "drjit", "cv2"} == set()


def test_fast_imports_pause_garbage_collection_only_at_the_start_of_a_process() -> None:
    program = """
import gc
from pipeline.cli.imports import fast_imports
seen = [gc.isenabled()]
for _ in range(2):
    with fast_imports():
        import pydantic.main
        seen.append(gc.isenabled())
    seen.append(gc.isenabled())
print(seen, gc.get_freeze_count() > 1000)
"""
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[True, False, True, True, True] True"


def test_the_page_of_the_command_line_says_what_there_is() -> None:
    page = (CONFIGS.parent / "docs/reference/command_line.md").read_text()
    for code in (cli.DONE, cli.FAILED, cli.WRONG_INPUT, cli.INTERRUPTED):
        assert f"| {code} |" in page
    for option in ("--json", "--quiet", "--debug", "completion", "init", "schema"):
        assert option in page

"""Wrong files, values and folders are refused before any work, with a message that names the option or file to mend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from monitor_cases import UTM, las, points

from pipeline.change.areas import check_some_inside
from pipeline.cli.main import main
from pipeline.formats.measurements.config import MeasurementConfig
from pipeline.monitoring.options import MonitorOptions, read_areas
from pipeline.monitoring.reading import find_epochs
from pipeline.monitoring.run import monitor
from pipeline.monitoring.site import prepared
from scene.blocks.block import RockfallConfig
from scene.common.config import load_yaml, parse
from scene.common.errors import InputError


def said(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """Run a command that must be refused, and return its message."""
    assert main([str(word) for word in words]) == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    return message


def wall_file(path: Path, spoilt: float = 0.0) -> Path:
    """Write a mesh of one triangle, and return its path. spoilt: first coordinate of the first vertex."""
    vertices = np.array([[spoilt, 0, 0], [1, 0, 0], [0, 0, 1]], dtype=float)
    trimesh.Trimesh(vertices, [[0, 1, 2]], process=False).export(path)
    return path


def test_init_refuses_a_mesh_with_vertices_that_are_not_finite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "site.yaml"
    message = said(capsys, "init", "--mesh", wall_file(tmp_path / "nan.ply", np.nan), "--out", out)
    assert "--mesh: " in message
    assert "nan.ply: 1 of 3 vertices are not finite" in message
    assert not out.exists()


def test_init_refuses_a_point_cloud_as_mesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wall.laz").write_bytes(b"LASF")
    message = said(capsys, "init", "--mesh", tmp_path / "wall.laz", "--out", tmp_path / "site.yaml")
    assert "'.laz' is not a mesh format" in message
    assert "scarpsim surface" in message


def test_init_takes_a_mesh_in_any_unit(tmp_path: Path) -> None:
    mesh = tmp_path / "wall.obj"
    mesh.write_text("# unit: mm\nv 0 0 0\nv 9000 0 0\nv 0 0 9000\nf 1 2 3\n")
    assert main(["init", "--mesh", str(mesh), "--out", str(tmp_path / "site.yaml")]) == 0


def test_init_refuses_a_file_that_is_no_calibration_of_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.yaml").write_text("sensor: tls\n")
    message = said(capsys, "init", "--cameras", tmp_path / "model.yaml", "--out", tmp_path / "site.yaml")
    assert "--cameras: " in message
    assert "'left' is missing" in message


@pytest.mark.parametrize("option", ["--site", "--scanner"])
def test_init_names_the_option_of_an_unknown_name(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"error: {option}: " in said(capsys, "init", option, "nowhere", "--out", tmp_path / "site.yaml")


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("wall=wall.ply", "for a mesh file write wall: {mesh: FILE}"),
        ("wall.mesh=wall.ply", "`mesh` cannot be combined with height_m"),
        ("sensor=negative.yaml", "negative.yaml: keys or values are wrong"),
        ("sensor=nosuch", "there is no bundled config 'nosuch'"),
        ("rockfall.size_m=-1", "lengths must be above 0 m, but are -1 m at most"),
        ("planning.block_size_m=[-0.2]", "'planning.block_size_m.0': input should be greater"),
    ],
)
def test_the_override_that_is_wrong_is_named(
    override: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("negative.yaml").write_text("sensor: tls\nnoise: {range_sigma_m: -0.003}\n")
    message = said(capsys, "simulate", "--sensor", "tls", "--set", "seed=2", "--set", override, "--out", "out")
    assert f"error: --set {override}: " in message
    assert problem in message
    assert "demo.yaml" not in message
    assert not Path("out").exists()


def test_a_config_file_that_is_wrong_itself_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "site.yaml"
    config.write_text("rockfall: {count: 0}\n")
    words = ("simulate", "--sensor", "tls", "--config", config, "--set", "seed=2", "--out", tmp_path / "out")
    assert f"error: {config}: keys or values are wrong: 'rockfall.count'" in said(capsys, *words)


@pytest.mark.parametrize(
    ("size", "never_positive"),
    [
        (0, True),
        ({"kind": "uniform", "low": -2, "high": -1}, True),
        ({"kind": "gaussian", "mean": -1, "sigma": 0}, True),
        ({"kind": "histogram", "edges": [-2, -1, 3], "counts": [1, 0]}, True),
        ([1, 1, -1], True),
        ({"kind": "mixture", "components": [-1, 1], "weights": [1, 0]}, True),
        ({"kind": "mixture", "components": [-1, 1], "weights": [1, 1]}, False),
        ({"kind": "uniform", "low": 0, "high": 1}, False),
        ({"kind": "gaussian", "mean": 1, "sigma": 1}, False),
        ({"kind": "lognormal", "median": 1, "sigma_log": 1}, False),
    ],
)
def test_lengths_of_blocks_that_are_never_positive_are_refused(size: object, *, never_positive: bool) -> None:
    if never_positive:
        with pytest.raises(InputError, match="lengths must be above 0 m"):
            parse(RockfallConfig, {"size_m": size}, "config")
    else:
        parse(RockfallConfig, {"size_m": size}, "config")


@pytest.mark.parametrize(
    ("text", "place"), [("a: [1,2\nb: 3\n", "line 2, column 2"), ("a: 1\na: 2\n", "line 2, column 1"), ("a: \0\n", "position 3")]
)
def test_an_error_of_syntax_names_the_file_and_the_place(text: str, place: str, tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text(text)
    with pytest.raises(InputError, match=r"broken\.yaml: the file is not valid YAML") as error:
        load_yaml(tmp_path / "broken.yaml")
    assert place in str(error.value)
    assert "unicode string" not in str(error.value)


@pytest.mark.parametrize("words", [["simulate", "--sensor", "tls"], ["inspect", "glendale"]])
def test_a_folder_that_cannot_be_made_is_named_as_option(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "error: --out /proc/foo: the path cannot be used as a folder: no folder can be created in /proc" in said(
        capsys, *words, "--out", "/proc/foo"
    )


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["calibrate", "empty", "--out", "out"], "empty: the folder contains no measured epochs"),
        (["train", "empty", "--out", "out"], "empty: the folder is no data set to train on (train/annotations.json is missing)"),
        (["train", "nothere", "--out", "out"], "nothere: there is no such folder"),
        (["train", "split", "--out", "out"], "this is one part of a data set"),
        (["export", "empty", "picture"], "empty: the folder contains no run (run.json is missing)"),
        (["export", "nothere", "picture"], "nothere: there is no such folder"),
        (["export", "nothere", "yolo"], "nothere: there is no such folder"),
        (["gap", "--identifiability", "scan.laz", "--out", "out"], "scan.laz: the file is neither a config nor a measurement"),
        (["measurement", "scan.laz", "--reference", "link.laz", "--scanner", "riegl_vz400i", "--out", "out"], "the scan itself"),
        (["measurement", "scan.laz", "--reference", "scan.laz", "--photographs", "--out", "out"], "the scan itself"),
        (["gap", "scan.laz", "--reference", "scan.laz", "--scanner", "riegl_vz400i", "--out", "out"], "the scan itself"),
    ],
)
def test_folders_and_files_of_another_kind_are_called_so(
    words: list[str], problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("split").mkdir()
    Path("split/annotations.json").write_text("{}")
    Path("scan.laz").write_bytes(b"LASF")
    Path("link.laz").symlink_to("scan.laz")
    assert problem in said(capsys, *words)
    assert not Path("out").exists()


def test_a_measurement_is_not_its_own_reference() -> None:
    values = {"sensor": "stereo", "reference": "a.ply", "points": ["b.ply", "a.ply"], "model": "model.yaml"}
    with pytest.raises(InputError, match="'reference' and 'points' name the same file"):
        parse(MeasurementConfig, values, "measurement.yaml")


@pytest.mark.parametrize("area", [[10, 5, 2, 8], [2, 8, 10, 5], [2, 5, 2, 8]])
def test_a_box_of_stable_rock_needs_its_lower_corner_first(area: list[float], tmp_path: Path) -> None:
    (tmp_path / "stable.yaml").write_text(f"[{area}]\n")
    with pytest.raises(InputError, match="x0 must be below x1 and y0 below y1"):
        read_areas(tmp_path / "stable.yaml")


def test_areas_outside_the_wall_are_refused_with_the_extent_of_the_wall() -> None:
    x, y = np.array([0.0, 16.0]), np.array([0.0, 10.0])
    with pytest.raises(
        InputError, match=r"--stable: no measured point lies in any of the areas.* x 0\.0 to 16\.0 m and y 0\.0 to 10\.0 m"
    ):
        check_some_inside(np.array([False, False]), x, y, "--stable")
    check_some_inside(np.array([False, True]), x, y, "--stable")


@pytest.fixture
def epochs(tmp_path: Path) -> list[str]:
    """Return the files of two epochs of one wall."""
    return [str(las(tmp_path / f"{name}.las", points(20_000, seed))) for seed, name in enumerate("ab")]


@pytest.mark.parametrize(
    ("area", "kept"), [("[100, 100, 120, 120]", False), ("[0, 0, 0, 1, 1, 1]", False), ("[1, 1, 12, 8]", True)]
)
def test_monitor_checks_stable_areas_on_the_reference(area: str, *, kept: bool, epochs: list[str], tmp_path: Path) -> None:
    (tmp_path / "stable.yaml").write_text(f"[{area}]\n")
    options = MonitorOptions(position=UTM + np.array([8.0, -50.0, 5.0]), stable=read_areas(tmp_path / "stable.yaml"))
    sources = find_epochs([Path(each) for each in epochs], ())
    if kept:
        assert prepared(sources[0], options).grid.width > 0
    else:
        with pytest.raises(InputError, match="--stable: no measured point lies in any of the areas"):
            monitor(sources, tmp_path / "out", options)
        assert not (tmp_path / "out").exists()


def test_monitor_has_nothing_to_resume_in_a_folder_without_results(
    epochs: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = said(capsys, "monitor", *epochs, "--out", tmp_path / "out", "--resume")
    assert "there is no monitoring to resume" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("follows", [False, True])
def test_monitor_refuses_a_detector_that_is_none_before_any_work(
    epochs: list[str], *, follows: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    further = ["--follow", str(tmp_path)] if follows else epochs[1:]
    message = said(capsys, "monitor", epochs[0], *further, "--out", tmp_path / "out", "--detector", "nosuch")
    assert "error: --detector nosuch: the folder holds no detector" in message
    assert not (tmp_path / "out").exists()

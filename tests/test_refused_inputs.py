"""Wrong files, values and folders are refused before any work, with a message that names the option or file to mend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.cli.main import main
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
    assert "error: --out /proc/foo: the folder cannot be created in /proc" in said(capsys, *words, "--out", "/proc/foo")

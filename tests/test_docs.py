"""The documentation: the site builds without a warning, and its guides, tutorials and notebooks work as written."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from typing import Any

import example_data
import howtos
import nbformat
import numpy as np
import pytest
import yaml
from nbclient import NotebookClient
from shared_outputs import build_site, made_once

from pipeline.formats.points.laz import read_laz
from scene.common.config import load_yaml, parse
from sensors.models.sensor_model import TlsModel

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
SMALL_WALL = ["--set", "wall.width_m=7", "--set", "wall.height_m=5", "--set", "wall.resolution_m=0.1"]
FEW_POINTS = [
    *("--set", "scanner.azimuth_step_rad=0.001", "--set", "scanner.zenith_step_rad=0.001"),
    *("--set", "depth_map=low", "--set", "difference.gsd_m=0.05"),
]
FEW_BLOCKS = ["--set", "rockfall.count=3"]
COARSE_PLAN = ["--set", "planning.gsd_m=0.2"]
SMALL_SET = (
    "[wall.width_m=9,wall.height_m=5,wall.resolution_m=0.1,cameras.distance_m=20,cameras.base_m=5,depth_map=low,station.distance_m=20,"
    "scanner.azimuth_step_rad=0.004,scanner.zenith_step_rad=0.004,difference.gsd_m=0.05]"
)
FURTHER = {
    "own_site": {
        "scarpsim inspect": [*FEW_POINTS, *COARSE_PLAN],
        "simulate": [*FEW_POINTS, *FEW_BLOCKS, "--set", "epochs=1"],
    },
    "training_set": {
        "scarpsim dataset my_set.yaml": [
            *("--set", "tiles.size_px=48", "--set", f"walls.near.set={SMALL_SET}", "--set", f"walls.other.set={SMALL_SET}"),
            *("--set", "parts.0.train=1"),
        ],
    },
    "compare_sensors": {
        "scarpsim compare": [*SMALL_WALL, *FEW_POINTS, "--epochs", "2", "--sizes-m", "0.3", "0.6"],
        "scarpsim inspect": [*SMALL_WALL, *FEW_POINTS, *COARSE_PLAN],
    },
    "calibrate": {
        "simulate": [*SMALL_WALL, *FEW_POINTS, *FEW_BLOCKS],
        "scarpsim calibrate": [
            *SMALL_WALL,
            *FEW_POINTS,
            *("--set", "calibration.windows=6", "--set", "calibration.window_px=16", "--set", "calibration.simulations=60"),
            "--no-greedy",
        ],
    },
    "missing_effect": {"simulate": [*SMALL_WALL, *FEW_POINTS, *FEW_BLOCKS]},
    "raw_scan": {},
    "simulate_and_look": {"simulate": [*SMALL_WALL, *FEW_POINTS, *FEW_BLOCKS]},
    "two_scans_to_a_finding": {
        "simulate": ["--set", "scanner.azimuth_step_rad=0.003", "--set", "scanner.zenith_step_rad=0.003"],
    },
    "detector_for_my_site": {
        "scarpsim dataset": ["--set", "parts.0.train=1", "--set", "parts.0.val=1", "--set", "tiles.size_px=192"],
        "scarpsim train": ["--set", "training.epochs=1"],
        "scarpsim detect": ["--no-pictures"],
        "simulate": [*SMALL_WALL, *FEW_POINTS, *FEW_BLOCKS],
    },
    "close_the_circle": {
        "simulate": ["--set", "scanner.azimuth_step_rad=0.003", "--set", "scanner.zenith_step_rad=0.003"],
        "scarpsim calibrate": [
            *("--set", "calibration.windows=6", "--set", "calibration.window_px=16", "--set", "calibration.simulations=60"),
            "--no-greedy",
        ],
        "scarpsim dataset": [
            *("--set", "tiles.size_px=32", "--set", "parts.0.train=1", "--set", "parts.0.val=1", "--set", "parts.0.test=0"),
        ],
        "scarpsim train": ["--set", "training.epochs=1"],
    },
}
"""What is added to the pages' commands, so that they are done in seconds."""


def test_the_site_builds_without_a_warning(tmp_path_factory: pytest.TempPathFactory) -> None:
    """In `strict` mode a bad link, anchor or a page missing from the navigation is an error. Nothing is fetched."""
    pages = list(made_once(tmp_path_factory, "site", build_site).rglob("*.html"))
    assert len(pages) > 80
    fetched = re.compile(r'<(?:script|img|iframe)[^>]* src="(?:https?:)?//|<link[^>]* rel="stylesheet"[^>]* href="(?:https?:)?//')
    without_words = re.compile(r'<img(?![^>]* alt="[^"]+)[^>]*>')
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not fetched.search(text), page
        assert not without_words.search(text), f"{page}: a picture without alternative text"


CHECKED_ELSEWHERE = (
    "add_effect",
    "add_sensor",
    "add_wall_style",
    "export",
    "monitor",
    "plan_survey",
    "plug_ins",
    "series",
    "view",
)
"""How-tos that other tests check: test_docs_commands.py, monitor/, test_plug_ins.py, test_building.py, test_series.py."""


def test_every_how_to_has_its_picture() -> None:
    assert {path.stem for path in (ROOT / "docs" / "howto").glob("*.md")} == {*howtos.PICTURES, *CHECKED_ELSEWHERE}
    for page in howtos.PICTURES:
        assert f"(../images/howto_{page}.png)" in (ROOT / "docs" / "howto" / f"{page}.md").read_text()
        assert (ROOT / "docs" / "images" / f"howto_{page}.png").is_file()


def test_every_tutorial_is_carried_out_and_has_a_picture() -> None:
    pages = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    assert {path.stem for path in pages} == set(howtos.TUTORIALS)
    for path in pages:
        pictures = re.findall(r"\((\.\./images/[^)]+)\)", path.read_text())
        assert pictures
        assert all((path.parent / picture).is_file() for picture in pictures)


@pytest.mark.parametrize("page", [*howtos.PICTURES, *howtos.TUTORIALS])
def test_a_page_works_as_it_is_written(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command of a how-to guide or tutorial, on small scenes."""
    monkeypatch.chdir(tmp_path)
    if howtos.NEEDS.get(page) == "site":
        example_data.site(Path(), resolution_m=0.2)
    if howtos.NEEDS.get(page) == "measurement":
        example_data.measurement(Path("my_measurement"), step_rad=0.012)
    howtos.carry_out(page, FURTHER[page])
    if page in howtos.PICTURES:
        assert Path(howtos.PICTURES[page]).is_file()
    CLAIMS[page]()


def read(path: str) -> Any:
    return json.loads(Path(path).read_text())


def a_site_is_simulated() -> None:
    """Assert that both sensors use the mesh and the named scanner, and that results have survey coordinates."""
    for sensor in ("stereo", "tls"):
        assert Path(read(f"runs/{sensor}/run.json")["config"]["wall"]["mesh"]).name == "wall.ply"
        points = read_laz(Path(f"runs/{sensor}/epoch_001/points_world.laz")).points
        assert np.abs(points.mean(axis=0) - example_data.ORIGIN).max() < 30
    config = read("runs/tls/run.json")["config"]
    assert config["scanner"]["name"] == "RIEGL VZ-400i"
    assert [effect["name"] for effect in config["sensor"][-1]["effects"]] == ["beam_divergence"]


def a_set_is_made() -> None:
    assert {path.name for path in Path("sets/my_set").iterdir()} >= {"dataset.json", "train", "val", "test"}


def sensors_are_compared() -> None:
    assert "riegl_vz400i" in Path("comparison/comparison.json").read_text()
    assert read("plan/plan.json")["config"]["scanner"]["name"] == "RIEGL VZ-400i"
    assert read("plan/plan.json")["config"]["planning"]["block_size_m"] == [0.2]


def the_calibrated_model_is_simulated() -> None:
    (model,) = read("runs/calibrated/run.json")["config"]["sensor"]
    assert model == parse(TlsModel, load_yaml(Path("calibration/calibrated.yaml")), "calibrated").model_dump(mode="json")
    assert model["noise"]["range_sigma_m"] != TlsModel().noise.range_sigma_m


def what_the_gap_names_is_simulated() -> None:
    (model,) = read("runs/with_the_effect/run.json")["config"]["sensor"]
    assert model == parse(TlsModel, load_yaml(Path("diagnosis/model_after.yaml")), "after").model_dump(mode="json")
    assert [f"tls.{effect['name']}" for effect in model["effects"]] == [
        each["name"] for each in read("diagnosis/gap.json")["effects"]
    ]


def the_scanner_is_found() -> None:
    """Assert that the position agrees to a millimetre with the one in the example's own measurement."""
    places = [
        yaml.safe_load(Path(folder, "measurement.yaml").read_text())["scanner"]["position_m"]
        for folder in ("my_measurement", "from_raw")
    ]
    assert np.abs(np.subtract(*places)).max() < 1e-3
    assert "found from the scan lines" in Path("from_raw/understood.txt").read_text()


def four_runs_are_made() -> None:
    assert {path.name for path in Path("runs").iterdir()} == {"scanner", "pair", "scanner_far", "pair_far"}
    distances = [read(f"runs/{name}/run.json")["config"]["station"]["distance_m"] for name in ("scanner", "scanner_far")]
    assert distances == [50, 100]


def the_bias_and_the_rockfall_are_found() -> None:
    found = read("finding/gap.json")
    (effect,) = found["effects"]
    assert effect["name"] == "tls.range_incidence_bias"
    assert effect["parameters"]["coefficient_m"]["value"] == pytest.approx(0.006, abs=0.001)
    assert found["scene_changes"]


def a_detector_is_trained_and_used() -> None:
    for folder in ("found", "found_by_default", "found_by_threshold"):
        assert read(f"{folder}/detections.json")
    assert Path("found_in_run/events_0.95.csv").is_file()


def the_next_epoch_is_searched_by_the_detector() -> None:
    found = read("spring/monitor.json")
    assert [each["missing_m3"] > 0.1 for each in found["epochs"]] == [True, True]
    june = read("june/monitor.json")
    assert june["options"]["detector"] == "detector/best"
    assert all(each["score"] > 0 for each in june["events"])


CLAIMS = {
    "own_site": a_site_is_simulated,
    "training_set": a_set_is_made,
    "compare_sensors": sensors_are_compared,
    "calibrate": the_calibrated_model_is_simulated,
    "missing_effect": what_the_gap_names_is_simulated,
    "raw_scan": the_scanner_is_found,
    "simulate_and_look": four_runs_are_made,
    "two_scans_to_a_finding": the_bias_and_the_rockfall_are_found,
    "detector_for_my_site": a_detector_is_trained_and_used,
    "close_the_circle": the_next_epoch_is_searched_by_the_detector,
}
"""What the pages say that their commands do."""


def test_the_effect_of_the_page_on_adding_one_is_an_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page has the same code as the notebook, which uses it."""
    code = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "howto" / "add_effect.md").read_text(), re.DOTALL)[0]
    (tmp_path / "warm_up.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    effect = importlib.import_module("warm_up").RangeWarmUp
    assert effect().is_null
    assert not effect(amplitude_m=0.005).is_null
    cells = nbformat.read(ROOT / "docs" / "notebooks" / "own_effect.ipynb", as_version=4).cells
    assert any(code[code.index("class ") :].strip() in cell.source for cell in cells)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    for cell in notebook.cells:
        pictures = [output for output in cell.get("outputs", []) if "image/png" in output.get("data", {})]
        assert not pictures or cell.metadata.get("alt"), f"a picture without words for it:\n{cell.source}"

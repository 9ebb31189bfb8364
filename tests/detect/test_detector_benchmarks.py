"""The detector's benchmarks run at a tiny size with an untrained network; their results mean nothing here."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest
from test_model import SMALL, make_set

from pipeline.detection.inference import weights
from pipeline.detection.network.config import TrainConfig, TrainingConfig

pytestmark = pytest.mark.skipif(importlib.util.find_spec("keras") is None, reason="Keras is not installed")
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SIDE = 64
NETWORK = SMALL.model_copy(update={"image_px": SIDE, "pyramid_channels": 8})
TRAINING = TrainConfig(detector=NETWORK, training=TrainingConfig(crop_px=None, batch=2, epochs=1))
WALLS, LEVELS = ("glendale-b", "bulga-b", "bismantova", "pilkington"), ("2.5cm", "5cm", "7.5cm")
SENSORS, SIZES = ("stereo", "tls"), ("small", "medium", "large")


def labelled(folder: Path, count: int) -> Path:
    """Write tiles whose records hold wall, noise, sensor and block size, and for each block its signal-to-noise ratio."""
    make_set(folder, 1, seed=count, side=SIDE, blocks=1)
    whole = json.loads((folder / "annotations.json").read_text())
    image, annotation = whole["images"][0], {**whole["annotations"][0], "signal_to_noise": 9.0, "ignore": 0}
    kinds = list(itertools.islice(itertools.cycle(itertools.product(SIZES, WALLS, LEVELS, SENSORS)), count))
    keys = [dict(zip(("size_class", "wall", "noise", "sensor"), kind, strict=True)) for kind in kinds]
    whole["images"] = [{**image, "id": number, "file_name": f"{number}.tif", **each} for number, each in enumerate(keys, start=1)]
    for number in range(2, count + 1):
        shutil.copy(folder / "1.tif", folder / f"{number}.tif")
    whole["annotations"] = [
        {**annotation, "id": number, "image_id": number, "size_class": each["size_class"]}
        for number, each in enumerate(keys, start=1)
    ]
    (folder / "annotations.json").write_text(json.dumps(whole))
    return folder


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("detector") / "set"
    for part in ("train", "val", "test"):
        labelled(folder / part, len(SIZES) * len(WALLS) * len(LEVELS) * len(SENSORS) if part == "test" else 72)
    sizes = {size: {"rockfall": {"placement": "mean"}} for size in SIZES}
    (folder / "dataset.json").write_text(json.dumps({"sources": {"one": {"config": {"sizes": sizes}}}}))
    return folder


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from pipeline.detection.network.model import MaskRCNN  # takes seconds

    folder = tmp_path_factory.mktemp("network")
    weights.save(MaskRCNN(NETWORK, seed=3), folder)
    return folder


def script(name: str, monkeypatch: pytest.MonkeyPatch, *words: object) -> ModuleType:
    """Load a benchmark with its command-line arguments set."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, words)])
    return importlib.import_module(name)


@pytest.mark.usefixtures("eager")
def test_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "tiny.yaml"
    config.write_text(TRAINING.model_dump_json())
    benchmark = script("detector", monkeypatch, "--config", config)
    monkeypatch.setattr(benchmark, "ROUNDS", 1)
    tensorflow = pytest.importorskip("tensorflow")
    for name in ("set_intra_op_parallelism_threads", "set_inter_op_parallelism_threads"):  # TensorFlow runs by now
        monkeypatch.setattr(tensorflow.config.threading, name, lambda _: None)
    benchmark.main()
    assert "images/s" in capsys.readouterr().out


@pytest.mark.usefixtures("eager")
def test_ablation(data_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--set", data_set, "--test", data_set, "--out", tmp_path / "out", "--epochs", "1", "--seeds", "1")
    benchmark = script("detector_ablation", monkeypatch, *words)
    monkeypatch.setattr(benchmark, "CHANGES", (benchmark.CHANGES[0], benchmark.CHANGES[-1]))
    monkeypatch.setattr(benchmark, "load_train_config", lambda *_: TRAINING)
    monkeypatch.setattr(benchmark, "ONE_WALL", {"wall": WALLS[0], "size_class": "medium"})
    monkeypatch.setattr(benchmark, "part", _one_tile_of_each(benchmark.part))
    benchmark.main()
    assert capsys.readouterr().out.count("|") > 12


def _one_tile_of_each(part):
    """Return `part` of a data set, reduced to the first tile of each size, because training goes tile by tile."""

    def few(folder: Path, out: Path, **options: object) -> Path:
        part(folder, out, **options)
        whole = json.loads((out / "annotations.json").read_text())
        kept = {image["size_class"]: image for image in reversed(whole["images"])}.values()
        numbers = {image["id"] for image in kept}
        whole["images"] = list(kept)
        whole["annotations"] = [each for each in whole["annotations"] if each["image_id"] in numbers]
        (out / "annotations.json").write_text(json.dumps(whole))
        return out

    return few


@pytest.mark.usefixtures("eager")
def test_table(data_set: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    script("detector_table", monkeypatch, "--set", data_set, "--model", "baseline").main()
    assert "mean, laser scanner" in capsys.readouterr().out


@pytest.mark.usefixtures("eager")
def test_curve(data_set: Path, detector: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    script("detector_curve", monkeypatch, "--set", data_set, f"1000={detector}").main()
    assert "| 1,000 |" in capsys.readouterr().out


@pytest.mark.usefixtures("eager")
def test_drawn(data_set: Path, detector: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    benchmark = script("detector_drawn", monkeypatch, "--set", data_set, "--split", "val", "--model", detector)
    monkeypatch.setattr(benchmark, "CONFIDENCE", 0.0)
    monkeypatch.setattr(benchmark, "FOUND", 1e-6)
    monkeypatch.setattr(benchmark, "CocoFolder", _every_24th(benchmark.CocoFolder))
    benchmark.main()
    assert "true masks" in capsys.readouterr().out


@pytest.mark.usefixtures("eager")
def test_mirrored(data_set: Path, detector: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    script("detector_mirrored", monkeypatch, "--set", data_set, "--every", "24", "--model", detector).main()
    assert "up-down" in capsys.readouterr().out


def _every_24th(folder_class):
    """Return a folder class that holds one tile of each block size."""

    def few(path: Path):
        folder = folder_class(path)
        folder.images = folder.images[::24]
        return folder

    return few

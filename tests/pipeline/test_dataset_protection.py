"""A data set's files are checked before they are used: damage is found, and no file name leads out of the folder."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_dataset import TINY, digests, tiny

from pipeline.cli.main import main
from pipeline.dataset import records
from pipeline.dataset import run as run_module
from pipeline.dataset.combine import merge_datasets, split_dataset
from pipeline.dataset.folder import fingerprint
from pipeline.dataset.loaders import Tiles
from pipeline.dataset.records import read_dataset_file, read_shard, write_dataset_file, write_shard
from pipeline.dataset.run import Workers, make_dataset, verify_dataset
from pipeline.dataset.worker import EpochOrder
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.products.run import find_inputs
from pipeline.formats.cameras.colmap import write_colmap
from pipeline.formats.cameras.opencv import write_opencv
from pipeline.formats.files.inside import inside
from scene.common.errors import InputError
from sensors.cameras.camera import Camera

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "set"
    make_dataset(tiny(sensors=["tls"], truth=False, parts=[{**TINY["parts"][0], "train": 1}]), out)
    return out


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "sets/set"))


def in_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the error message of a command that must end with exit status 2."""
    assert main(words) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    return error


def test_a_set_is_told_by_the_files_of_its_cameras(tmp_path: Path) -> None:
    """A camera folder may hold other files and folders; a lens file that cameras.yaml names belongs to the set."""
    lens = dict.fromkeys(("cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    camera = Camera(640, 480, 900.0, **lens, position=np.zeros(3), rotation=np.eye(3))
    write_colmap(tmp_path / "model", {"left": camera, "right": replace(camera, position=np.array([5.0, 0, 0]))})
    write_opencv(tmp_path / "lens.yml", camera)
    pose = f"{{calibration: lens.yml, position_m: [0, 0, 0], rotation: {np.eye(3).tolist()}}}"
    lines = [f"{side}: {pose}\n" for side in ("left", "right")]
    (tmp_path / "cameras.yaml").write_text("".join(lines))
    wall = TINY["walls"]["ledge"]
    folder, yaml = (tiny(walls={"ledge": {**wall, "cameras": {"file": tmp_path / name}}}) for name in ("model", "cameras.yaml"))
    before = [fingerprint(folder), fingerprint(yaml)]
    (tmp_path / "model/pictures").mkdir()
    (tmp_path / "model/pictures/1.jpg").write_text("a picture")
    assert [fingerprint(folder), fingerprint(yaml)] == before
    write_opencv(tmp_path / "lens.yml", replace(camera, k1=0.1))
    assert fingerprint(folder) == before[0]
    assert fingerprint(yaml) != before[1]


def test_nothing_is_left_of_the_lock(made: Path) -> None:
    assert not list(made.rglob(".*"))


def test_a_changed_digit_is_found_and_spoils_no_tile(made: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = copy / "dataset.json"
    text = path.read_text()
    path.write_text(text.replace('"size_px": 48', '"size_px": 49'))
    assert path.read_text() != text
    next((copy / "train").glob("*.tif")).unlink()
    before = digests(copy)
    for words in (["verify", str(copy), "--report-only"], ["verify", str(copy)]):
        assert "dataset.json: the file is damaged" in in_one_line(["dataset", *words, "--quiet"], capsys)
    assert digests(copy) == before


def test_a_config_that_is_not_the_epochs_own_makes_no_tile(copy: Path) -> None:
    """The config is replaced together with its checksum, as somebody could do on purpose."""
    known = read_dataset_file(copy)
    for source in known["sources"].values():
        source["config"]["annotation"]["minimum_area_px"] = 77
    write_dataset_file(copy, known["name"], known["sources"], known["epochs"], complete=True)
    next((copy / "train").glob("*.tif")).unlink()
    before = digests(copy)
    with pytest.raises(InputError, match="was changed after its epochs were made"):
        verify_dataset(copy)
    assert digests(copy) == before


@pytest.mark.parametrize("text", ["", "0  README.md\n"])
def test_a_list_of_checksums_that_lacks_files_is_damage(text: str, made: Path, copy: Path) -> None:
    (copy / "checksums.sha256").write_text(text)
    (found,) = verify_dataset(copy, repair=False).damage
    assert (str(found.file), found.problem) == ("checksums.sha256", "damaged")
    assert verify_dataset(copy).made == []
    assert digests(copy) == digests(made)


@pytest.mark.parametrize("name", ["train/*.tif", "shards/*.json", "val/annotations.json", "checksums.sha256"])
def test_a_folder_in_the_place_of_a_file_is_named(name: str, copy: Path) -> None:
    path = next(copy.glob(name))
    path.unlink()
    path.mkdir()
    assert "a folder" in [damage.problem for damage in verify_dataset(copy, repair=False).damage]
    with pytest.raises(InputError, match=f"{path.name}: a folder is in the place of a file of the set"):
        verify_dataset(copy)


def changed(**values: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda known: {**known, **values}


def prefixed(prefix: str) -> Callable[[dict[str, Any]], Any]:
    return lambda known: {
        **known,
        "sources": {name: {**source, "prefix": prefix} for name, source in known["sources"].items()},
    }


CHANGES: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda known: {}, "'schema' is missing"),
    (lambda known: [], "must be a mapping"),
    (lambda known: 3, "must be a mapping"),
    (changed(epochs={"x": 10**30}), "epochs"),
    (changed(epochs=10**30), "epochs"),
    (changed(sources={}), "sources"),
    (changed(name="../x"), "name"),
    (prefixed("../../.."), "prefix"),
    (prefixed("/tmp/x"), "prefix"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES)
def test_a_wrong_dataset_json_is_one_line(
    change: Callable[[dict[str, Any]], Any], message: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = copy / "dataset.json"
    values = change(read_dataset_file(copy))
    if isinstance(values, dict):
        values["sha256"] = records._digest(records._text(values))
    path.write_text(json.dumps(values))
    before = digests(copy)
    for words in (["verify", str(copy)], ["verify", str(copy), "--report-only"], ["split", str(copy), "--out", str(copy / "x")]):
        assert message in in_one_line(["dataset", *words], capsys)
    assert digests(copy) == before


def test_an_epoch_beyond_the_plan_is_named(copy: Path) -> None:
    known = read_dataset_file(copy)
    (source,) = known["epochs"]
    write_dataset_file(copy, known["name"], known["sources"], {source: [*known["epochs"][source], 10**9]}, complete=True)
    with pytest.raises(InputError, match="epoch 1000000000 is not in the plan of its config"):
        verify_dataset(copy)


def forged(folder: Path, file_name: str) -> None:
    """Rename the first tile in the first record, and give the record a right checksum."""
    name = sorted((folder / "shards").iterdir())[0].name
    record = read_shard(folder, name)
    assert record is not None
    record["tiles"][0]["image"]["file_name"] = file_name
    write_shard(folder, name, record)


@pytest.mark.parametrize("name", ["sub/../../../stolen.tif", "/tmp/scarpsim_stolen.tif", "../../stolen.tif"])
def test_names_in_a_shard_stay_in_the_set(name: str, copy: Path, tmp_path: Path) -> None:
    forged(copy, name)
    (tmp_path / "sets/stolen.tif").write_bytes(b"mine")
    (tmp_path / "stolen.tif").write_bytes(b"mine")
    with pytest.raises(InputError, match="lies outside of its folder"):
        split_dataset(copy, tmp_path / "deep/er/parts", ["sensor"])
    with pytest.raises(InputError, match="lies outside of its folder"):
        verify_dataset(copy, repair=False)
    assert not (tmp_path / "deep").exists() or not list((tmp_path / "deep").rglob("*stolen*"))


def test_a_link_out_of_the_set_is_not_followed(copy: Path, tmp_path: Path) -> None:
    tile = next((copy / "train").glob("*.tif"))
    tile.rename(tmp_path / "elsewhere.tif")
    tile.symlink_to(tmp_path / "elsewhere.tif")
    other = Path(shutil.copytree(copy, tmp_path / "other", symlinks=True))
    for call in (
        lambda: split_dataset(copy, tmp_path / "parts", ["sensor"]),
        lambda: merge_datasets([copy, other], tmp_path / "merged"),
        lambda: verify_dataset(copy),
    ):
        with pytest.raises(InputError, match=r"lies outside of its folder|another of the given sets has"):
            call()


@pytest.mark.parametrize("name", ["../secret.tif", "/etc/hostname", "link.tif", "", None, 3, "a\nb"])
def test_readers_of_annotations_stay_in_the_folder(name: Any, copy: Path) -> None:
    (copy / "secret.tif").write_bytes(next((copy / "train").glob("*.tif")).read_bytes())
    (copy / "train/link.tif").symlink_to(copy / "secret.tif")
    path = copy / "train/annotations.json"
    content = json.loads(path.read_text())
    content["images"][0]["file_name"] = name
    path.write_text(json.dumps(content))
    for read in (
        lambda: list(Tiles(copy / "train")),
        lambda: CocoFolder(copy / "train").labelled(0),
        lambda: find_inputs([copy / "train"]),
    ):
        with pytest.raises(InputError, match=r"annotations\.json"):
            read()


def test_names_that_stay(tmp_path: Path) -> None:
    assert inside(tmp_path, "tiles/a b.tif", "x") == tmp_path / "tiles/a b.tif"
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to("a")
    assert inside(tmp_path / "b", "c.tif", "x") == tmp_path / "b/c.tif"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError, match="which is impossible"):
        inside(tmp_path, "loop", "x")


def scaled(scale: Any) -> dict[str, Any]:
    return {"noise": {"low": {**TINY["noise"]["low"], "tls": {"model": {"sensor": "tls"}, "scale": scale}}}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensors": ["tls", "tls"]}, "a sensor is listed twice"),
        ({"noise": {"low": {**TINY["noise"]["low"], "tls": {"model": {"sensor": "tls"}, "scale": -1}}}}, "greater than or equal"),
        (
            {"noise": {"low": {**TINY["noise"]["low"], "tls": {"model": {"sensor": "tls"}, "scale": {"ledge": -1}}}}},
            "greater than",
        ),
    ],
)
def test_a_config_is_refused_before_its_first_epoch(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        tiny(**changes)


def test_a_job_that_cannot_begin_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster = pytest.importorskip("pipeline.dataset.cluster")
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    file, out = tmp_path / "set.yaml", tmp_path / "new/set"
    file.write_text(json.dumps(TINY))
    for options, message in (
        (["--scheduler", "tcp://127.0.0.1:9"], "no scheduler answers"),
        (["--workers", "100000"], "--workers: the number of workers is 100,000; allowed: 1 to"),
        (["--by", "sensor"], "--by: the option works only with scarpsim dataset split"),
        (["--report-only"], "--report-only: the option works only with scarpsim dataset verify"),
        (["--set", "tiles.size_px=4096"], "columns of tiles"),
    ):
        assert message in in_one_line(["dataset", str(file), "--out", str(out), "--quiet", *options], capsys)
        assert not out.parent.exists()


def test_what_others_put_there_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.dataset import run

    def fails(order: Any) -> Any:
        (tmp_path / "set/notes.txt").write_text("mine")
        raise InputError("no room")

    monkeypatch.setattr(run, "make_and_store", fails)
    with pytest.raises(InputError, match="no room"):
        make_dataset(tiny(), tmp_path / "set")
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["notes.txt"]


def test_too_many_workers_are_refused_by_verify_too(copy: Path) -> None:
    with pytest.raises(InputError, match="--workers"):
        verify_dataset(copy, Workers(100_000))


@pytest.mark.parametrize("spoil", ["tile", "shard"])
def test_a_set_that_is_not_whole_is_neither_merged_nor_split(spoil: str, copy: Path, tmp_path: Path) -> None:
    """The last epoch is damaged: what was already copied is removed again."""
    tile = max((copy / "test").glob("*.tif"))
    path = tile if spoil == "tile" else max((copy / "shards").glob("*.json"))
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(InputError, match="is missing or damaged; run scarpsim dataset verify"):
        split_dataset(copy, tmp_path / "parts", ["sensor"])
    assert not (tmp_path / "parts").exists()


@pytest.mark.parametrize("name", [".staging", "shards", "val"])
@pytest.mark.parametrize("make", [os.mkfifo, Path.touch, lambda path: path.symlink_to("nowhere")])
def test_what_stands_in_the_place_of_a_folder_is_named(
    name: str, make: Callable[[Path], object], copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(copy / name, ignore_errors=True)
    make(copy / name)
    before = sorted(copy.rglob("*"))
    assert f"{name}: the path is not a folder" in in_one_line(["dataset", "verify", str(copy), "--quiet"], capsys)
    assert sorted(copy.rglob("*")) == before


def test_nothing_is_staged_through_a_link(copy: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (copy / ".staging").symlink_to(tmp_path / "elsewhere")
    next((copy / "train").glob("*.tif")).unlink()
    with pytest.raises(InputError, match="is not a folder"):
        verify_dataset(copy)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_an_epoch_that_cannot_be_made_again_leaves_nothing(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(order: EpochOrder) -> dict[str, Any]:
        (copy / ".staging" / order.job).mkdir(parents=True)
        raise InputError("cannot be made")

    next((copy / "train").glob("*.tif")).unlink()
    monkeypatch.setattr(run_module, "make_and_store", fails)
    with pytest.raises(InputError, match="cannot be made"):
        verify_dataset(copy)
    assert not (copy / ".staging").exists()

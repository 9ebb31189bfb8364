"""Jobs that make data sets, in a process of their own as the command starts them, and their interruptions."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pycocotools.coco import COCO
from shared_outputs import made_once
from tiny_dataset import COMMAND, EPOCHS, ROOT, TINY, digests, tiny, tiny_set

from pipeline.config.bundled import bundled_config
from pipeline.dataset.combine import merge_datasets
from pipeline.dataset.config import load_dataset_config
from pipeline.dataset.plan import planned_epochs
from pipeline.dataset.run import Workers, make_dataset
from pipeline.formats.files.lock import LOCK, locked
from scene.common.errors import InputError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "tiny_set", tiny_set)


def test_two_jobs_on_one_folder_refuse_each_other(tmp_path: Path) -> None:
    with (
        locked(tmp_path / "set"),
        pytest.raises(InputError, match=rf"in use by process {os.getpid()} on .*wait for that process"),
    ):
        make_dataset(tiny(), tmp_path / "set")
    with locked(tmp_path / "set"):
        assert (tmp_path / "set" / LOCK).exists()


PROGRAM = """
import json, sys
from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.run import Workers, make_dataset
if __name__ == "__main__":
    config = DatasetConfig.model_validate(json.loads(sys.argv[1]))
    command = "scarpsim dataset tiny.yaml --out DIR"
    print(len(make_dataset(config, __import__("pathlib").Path(sys.argv[2]), Workers(int(sys.argv[3])), command=command).made))
"""


def job(folder: Path, out: Path, workers: int = 0) -> subprocess.Popen[str]:
    program = folder / "job.py"
    program.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen(
        [sys.executable, str(program), json.dumps(TINY), str(out), str(workers)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "the job ended before the condition was met"
        assert time.monotonic() < end
        time.sleep(0.002)


KILLS: list[tuple[Callable[[Path], bool], int]] = [
    (lambda out: any((out / ".staging").glob("*/*/*.tif")) and any((out / "shards").glob("*.json")), 0),
    (lambda out: len(list((out / "shards").glob("*.json"))) >= 2, 2),
]
"""Cases: a condition on the folder of the data set, at which the job is killed, and the number of workers."""


@pytest.mark.parametrize("kills", [KILLS[:1], KILLS], ids=["alone", "then with workers"])
def test_a_killed_job_is_finished_by_the_next_with_the_same_checksums(
    kills: list[tuple[Callable[[Path], bool], int]], made: Path, tmp_path: Path
) -> None:
    """Kill a job while it writes an epoch's tiles, before its shard; then one whose workers outlive it for a while."""
    out = tmp_path / "set"
    for moment, workers in kills:
        process = job(tmp_path, out, workers)
        wait_for(lambda moment=moment: moment(out), process)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not (out / "train/annotations.json").exists()
    assert 0 < len(make_dataset(tiny(), out, command=COMMAND).made) < EPOCHS
    assert digests(out) == digests(made)
    assert not list(out.rglob(".*.part*"))
    assert not (out / ".staging").exists()


def test_a_killed_worker_costs_nothing(made: Path, tmp_path: Path) -> None:
    """Dask starts another worker, which gets the order of two epochs; the result does not show which worker made which epoch."""
    pytest.importorskip("distributed")
    import psutil

    out = tmp_path / "set"
    process = job(tmp_path, out, workers=2)
    wait_for(lambda: any((out / "shards").glob("*.json")), process)
    workers = [
        child for child in psutil.Process(process.pid).children(recursive=True) if "spawn_main" in " ".join(child.cmdline())
    ]
    workers[0].kill()
    assert int(process.communicate(timeout=300)[0]) == EPOCHS
    assert process.returncode == 0
    assert digests(out) == digests(made)


@pytest.mark.parametrize(
    ("name", "workers"), [("small", 1), ("small", 2), ("rockfall_9", 2), ("rockfall_9", 16), ("rockfall_9", 256)]
)
def test_epochs_that_share_a_stage_go_to_one_worker(name: str, workers: int) -> None:
    """Orders contain every epoch once and never two stages; short stages stay whole; there are enough orders for all workers."""
    from pipeline.dataset.cluster import runs
    from pipeline.dataset.worker import EpochOrder

    plan = planned_epochs(load_dataset_config(bundled_config("datasets", name)))
    found = runs([EpochOrder("folder", "job", "source", epoch.index, epoch.stage) for epoch in plan], workers)
    assert [order.index for run in found for order in run] == list(range(len(plan)))
    assert all(len({order.stage for order in run}) == 1 for run in found)
    assert max(len(run) for run in found) <= 8
    stages = len({epoch.stage for epoch in plan})
    if name == "small":
        assert len(found) == stages
    else:
        assert len(found) >= max(2 * workers - stages, stages)


def test_a_scheduler_of_the_users(made: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    out = tmp_path / "set"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        make_dataset(tiny(), out, Workers(scheduler=cluster.scheduler_address), command=COMMAND)
    assert digests(out) == digests(made)


def test_a_scheduler_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = pytest.importorskip("pipeline.dataset.cluster")
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    with pytest.raises(InputError, match=r"no scheduler answers at 'tcp://127\.0\.0\.1:9'"):
        make_dataset(tiny(), tmp_path / "set", Workers(scheduler="tcp://127.0.0.1:9"))


def test_a_worker_that_does_not_end_in_time_spoils_nothing(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with Dask's nanny on a busy machine: the set is finished, and the command ends."""
    distributed = pytest.importorskip("distributed")

    class Slow(distributed.LocalCluster):  # type: ignore[misc, name-defined]
        def close(self, timeout: float | None = None) -> None:
            super().close(timeout)
            raise TimeoutError

    monkeypatch.setattr(distributed, "LocalCluster", Slow)
    make_dataset(tiny(), tmp_path / "set", Workers(1), command=COMMAND)
    assert digests(tmp_path / "set") == digests(made)


def test_a_full_disk_stops_the_job_and_the_next_goes_on(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.dataset import worker

    out, writes = tmp_path / "set", iter(range(1000))
    write = worker.write_geotiff

    def full(path: Path, *arguments: Any, **options: Any) -> None:
        if next(writes) == 9:
            raise InputError("the disk is full, 0 MB are free", where=str(path), remedy="make room")
        write(path, *arguments, **options)

    monkeypatch.setattr(worker, "write_geotiff", full)
    with pytest.raises(InputError, match="the disk is full"):
        make_dataset(tiny(), out, command=COMMAND)
    monkeypatch.undo()
    make_dataset(tiny(), out, command=COMMAND)
    assert digests(out) == digests(made)


def test_an_interrupted_set_is_usable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.dataset import run

    out = tmp_path / "set"
    fill = run.make_and_store

    def interrupted(order: Any) -> dict[str, Any]:
        if order.index == 1:
            raise KeyboardInterrupt
        return fill(order)

    monkeypatch.setattr(run, "make_and_store", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_dataset(tiny(sensors=["tls"]), out)
    assert len(COCO(out / "train/annotations.json").imgs) > 0
    assert "Incomplete" in (out / "README.md").read_text()
    with pytest.raises(InputError, match="is not finished"):
        merge_datasets([out, out], tmp_path / "merged")

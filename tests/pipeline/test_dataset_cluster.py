"""Dask workers on this machine: no other user can give them work, and their death is handled within bounded time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.machinery import ModuleSpec
from multiprocessing.spawn import get_preparation_data
from pathlib import Path
from typing import Any

import psutil
import pytest
from tiny_dataset import ROOT, TINY

from pipeline.dataset import watchdog, worker
from pipeline.dataset.worker import EpochOrder
from scene.common.errors import OutsideError

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
pytest.importorskip("cryptography")
cluster = pytest.importorskip("pipeline.dataset.cluster")

ORDERS = [EpochOrder("folder", "job", "source", index, ("tls", "wall", "low", 1)) for index in range(4)]


def quickly(orders: Sequence[EpochOrder]) -> list[dict[str, Any]]:
    return [{"index": order.index} for order in orders]


def deadly(orders: Sequence[EpochOrder]) -> list[dict[str, Any]]:
    os.kill(os.getpid(), signal.SIGKILL)
    return []


def deadlocked(orders: Sequence[EpochOrder]) -> list[dict[str, Any]]:
    """Wait forever in native code, without Python's interpreter lock; the worker's own threads go on."""
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()
    return []


def slowly(orders: Sequence[EpochOrder]) -> list[dict[str, Any]]:
    """Use processor time and write a file to say so."""
    Path(os.environ["AT_WORK"]).touch()
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        sum(range(10_000))
    return quickly(orders)


def spawned() -> list[psutil.Process]:
    """Return the workers of this process."""
    found = []
    for child in psutil.Process().children(recursive=True):
        try:
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
        except psutil.Error:
            continue
    return found


@contextmanager
def killer(most: int) -> Iterator[list[int]]:
    """Start a thread that kills up to `most` workers as soon as they exist; return the list of those it killed."""
    killed: list[int] = []
    stop = threading.Event()

    def run() -> None:
        while not stop.is_set():
            for each in spawned():
                if len(killed) < most and each.pid not in killed:
                    each.kill()
                    killed.append(each.pid)
            time.sleep(0.02)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield killed
    finally:
        stop.set()
        thread.join()


def test_nobody_else_can_hand_the_workers_work() -> None:
    """Clients without certificates, or with others than the job's, are refused; there is no dashboard."""
    with ExitStack() as stack:
        own = cluster._local(stack, 1)
        client = cluster._client(stack, own)
        at_work = client.submit(time.sleep, 0.01)
        assert own.scheduler_address.startswith("tls://")
        for address, security in (
            (own.scheduler_address.replace("tls://", "tcp://"), None),
            (own.scheduler_address, distributed.Security.temporary()),
            (next(iter(client.nthreads())).replace("tls://", "tcp://"), None),
        ):
            with pytest.raises(OSError, match=r"."), distributed.Client(address, security=security, timeout=2) as stranger:
                stranger.submit(os.getpid).result(timeout=5)
        at_work.result(timeout=60)
        ports = {each.laddr.port for each in psutil.Process().net_connections() if each.status == psutil.CONN_LISTEN}
        assert 8787 not in ports
        assert {each.laddr.ip for each in psutil.Process().net_connections() if each.status == psutil.CONN_LISTEN} == {
            "127.0.0.1"
        }


def test_workers_killed_at_their_start_are_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "make_and_store_run", quickly)
    with killer(2) as killed:
        found = list(cluster.make_on_cluster(ORDERS, 1, ""))
    assert len(killed) == 2
    assert sorted(each["index"] for each in found) == [0, 1, 2, 3]


def test_workers_that_never_start_end_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "make_and_store_run", quickly)
    monkeypatch.setattr(cluster, "_STARTS", 2)
    with killer(1000) as killed, pytest.raises(OutsideError, match="run the same command to continue"):
        list(cluster.make_on_cluster(ORDERS, 1, ""))
    assert 2 <= len(killed) < 20


def test_an_epoch_that_kills_its_workers_ends_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "make_and_store_run", deadly)
    monkeypatch.setattr(cluster, "_LOOK_S", 0.5)
    with pytest.raises(OutsideError, match="run the same command to continue"):
        list(cluster.make_on_cluster(ORDERS, 1, ""))


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["at its start", "at work"])
def test_a_stopped_worker_is_replaced(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The worker gets SIGSTOP, which freezes it with its interpreter; the next one does the work."""
    monkeypatch.setenv("AT_WORK", str(tmp_path / "at_work"))
    monkeypatch.setattr(worker, "make_and_store_run", slowly)
    monkeypatch.setattr(cluster, "_LOOK_S", 0.5)
    monkeypatch.setattr(watchdog, "STALLED_S", 4.0)

    def stopped() -> None:
        while not (spawned() if moment == "at its start" else (tmp_path / "at_work").exists()):
            time.sleep(0.05)
        spawned()[0].send_signal(signal.SIGSTOP)

    stop = threading.Thread(target=stopped)
    stop.start()
    found = list(cluster.make_on_cluster(ORDERS, 1, ""))
    stop.join()
    assert sorted(each["index"] for each in found) == [0, 1, 2, 3]
    assert "used no processor time" in capfd.readouterr().err


def test_a_deadlocked_worker_ends_the_job(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(worker, "make_and_store_run", deadlocked)
    monkeypatch.setattr(cluster, "_LOOK_S", 0.5)
    monkeypatch.setattr(watchdog, "STALLED_S", 1.0)
    once = dask.config.set({"distributed.scheduler.allowed-failures": 0})
    with once, pytest.raises(OutsideError, match="run the same command to continue"):
        list(cluster.make_on_cluster(ORDERS, 1, ""))
    assert "used no processor time for 1 s" in capfd.readouterr().err


@pytest.fixture
def no_workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the address of a scheduler without workers, which is given up after 0.2 s."""
    monkeypatch.setattr(cluster, "_LOOK_S", 0.05)
    monkeypatch.setattr(cluster, "_EMPTY_S", 0.2)
    with distributed.LocalCluster(n_workers=0, processes=False, protocol="tcp", dashboard_address=None) as empty:
        yield empty.scheduler_address


def test_a_cluster_of_the_users_without_workers_ends_the_job(no_workers: str) -> None:
    with pytest.raises(OutsideError, match="the scheduler has no workers; finished epochs are kept"):
        list(cluster.make_on_cluster(ORDERS, 0, no_workers))


@pytest.mark.parametrize("error", [TimeoutError("late"), OSError("gone"), RuntimeError("Cannot change state of Timeout")])
def test_an_error_while_closing_does_not_hide_the_outcome(
    monkeypatch: pytest.MonkeyPatch, no_workers: str, error: Exception
) -> None:
    """The last error is that of a client on a busy machine, which was about to give up its connection to a dead scheduler."""
    close = distributed.Client.close

    def failing(client: distributed.Client, timeout: float | None = None) -> None:
        close(client, timeout=timeout)
        if timeout is not None:  # as the program closes it, not the collector
            raise error

    monkeypatch.setattr(distributed.Client, "close", failing)
    with pytest.raises(OutsideError, match="the scheduler has no workers"):
        list(cluster.make_on_cluster(ORDERS, 0, no_workers))


def test_a_scheduler_that_dies_ends_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_LOOK_S", 0.5)
    monkeypatch.setattr(cluster, "_LOST_S", 2.0)
    file = tmp_path / "scheduler.json"
    program = "from distributed.cli.dask_scheduler import main; main()"
    scheduler = subprocess.Popen(
        [sys.executable, "-c", program, "--port", "0", "--scheduler-file", str(file), "--no-dashboard", "--host", "127.0.0.1"],
        stderr=subprocess.DEVNULL,
    )
    while not file.exists():
        assert scheduler.poll() is None
        time.sleep(0.05)
    timer = threading.Timer(2.0, scheduler.kill)
    timer.start()
    with pytest.raises(OutsideError, match="run the same command to continue"):
        list(cluster.make_on_cluster(ORDERS, 0, json.loads(file.read_text())["address"]))
    scheduler.wait()


def test_an_interrupt_reaches_the_job_and_prints_no_traceback(tmp_path: Path) -> None:
    """Ctrl-C goes to all processes of the terminal."""
    file, out = tmp_path / "set.yaml", tmp_path / "set"
    file.write_text(json.dumps(TINY))
    program = "from pipeline.cli.main import main; raise SystemExit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", program, "dataset", str(file), "--out", str(out), "--workers", "1", "--quiet"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not any((out / "shards").glob("*.json")):
        assert process.poll() is None
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == 130
    assert "Traceback" not in error
    assert "interrupted" in error


def test_workers_do_not_run_the_script_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """While workers start, a spawned process is told neither the main module's file nor its name."""
    main = sys.modules["__main__"]
    for spec, file in ((None, "/tmp/my_script.py"), (ModuleSpec("my_package.__main__", None), "/tmp/my_package/__main__.py")):
        monkeypatch.setattr(main, "__spec__", spec, raising=False)
        monkeypatch.setattr(main, "__file__", file, raising=False)
        before = get_preparation_data("worker")
        assert {"init_main_from_path", "init_main_from_name"} & set(before)
        with cluster._workers_without_user_script():
            assert not {"init_main_from_path", "init_main_from_name"} & set(get_preparation_data("worker"))
        assert get_preparation_data("worker") == before

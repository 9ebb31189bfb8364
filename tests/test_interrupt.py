"""Ctrl-C works while native code occupies the main thread, for example while a thread waits for memory that nobody frees."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
DEADLOCK = """
import ctypes
from pipeline.cli import main as cli

def run(arguments):
    arguments.kept = "what was finished is kept"
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
    print("stuck", flush=True)
    for _ in range(2):
        libc.pthread_mutex_lock(mutex)

cli.COMMANDS["doctor"].run = run
raise SystemExit(cli.main(["doctor"]))
"""


def test_a_second_interrupt_ends_a_command_that_is_stuck() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", DEADLOCK],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "stuck\n"
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert error == "error: interrupted twice; what was finished is kept\n"

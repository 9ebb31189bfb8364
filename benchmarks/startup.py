"""Measure how long `scarpsim --help` takes, compared with starting a bare interpreter.

Run `python benchmarks/startup.py`.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

_REPEATS = 7
_LIMIT_S = 0.5


def seconds(*words: str) -> float:
    """Median wall time of a process, s."""
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main() -> None:
    bare = seconds("-c", "pass")
    for command in ("--help", "simulate --help", "view --help"):
        program = f"import sys; from pipeline.cli.main import main; sys.exit(main({command.split()}))"
        taken = seconds("-c", program)
        times, share = taken / bare, taken / _LIMIT_S
        print(f"scarpsim {command}: {taken:.2f} s, {times:.1f} x a bare interpreter's start; {share:.2f} of the limit")


if __name__ == "__main__":
    main()

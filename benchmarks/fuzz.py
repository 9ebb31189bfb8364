"""Try every reader and every command with 500 damaged files, odd values or odd arguments of each kind, instead of the tests' 25.

    python benchmarks/fuzz.py [EXAMPLES]
    python benchmarks/fuzz.py [EXAMPLES] --through [--commands evaluate detect ...]

The exit status is that of pytest: 0 if each was read, or refused with one line. --through: only the commands, each case as its
own process that runs to its end, with limits on time and memory; bad responses are printed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from itertools import count
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = ("tests/test_fuzz.py", "tests/test_fuzz_records.py", "tests/test_fuzz_commands.py", "tests/detect/test_coco.py")
sys.path.insert(0, str(ROOT))


def through(commands: list[str], examples: int) -> int:
    """Run `examples` cases of each command to the end, and return the number of bad answers."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import strategies as st

    from benchmarks.bad_inputs.case import Outcome, tried
    from benchmarks.bad_inputs.materials import make_small
    from benchmarks.bad_inputs.preloaded import Preloaded
    from benchmarks.bad_inputs.random_cases import drawn
    from benchmarks.bad_inputs.run import said

    same = settings(
        derandomize=True,
        database=None,
        max_examples=examples,
        phases=[Phase.generate],
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    os.environ["KERAS_BACKEND"] = "none"  # TensorFlow takes half a minute for each
    bad, numbers = 0, count()
    with tempfile.TemporaryDirectory(prefix="fuzz_") as name:
        folder = Path(name)
        make_small(folder / "materials")
        forked_from = Preloaded(folder / "bytecode", rooms=True)

        def badly(command: str) -> int:
            found: list[Outcome] = []

            @same
            @given(data=st.data())
            def answered(data: st.DataObject) -> None:
                case = drawn(data.draw, command, folder / "materials")
                found.append(tried(case, folder / "materials", folder / str(next(numbers)), forked_from))
                if found[-1].problems:
                    print(said(found[-1]), case.words, flush=True)

            answered()
            return sum(1 for each in found if each.problems)

        for command in commands:
            count_of_bad = badly(command)
            bad += count_of_bad
            print(f"{command}: {examples} drawn, {count_of_bad} answered badly", flush=True)
        forked_from.close()
    return bad


def main() -> int:
    from benchmarks.bad_inputs.random_cases import SET_UPS

    parser = argparse.ArgumentParser(description="random damage to what readers and commands are given")
    parser.add_argument("examples", type=int, nargs="?", default=500)
    parser.add_argument("--through", action="store_true", help="commands to their ends, each as a process")
    parser.add_argument("--commands", nargs="+", default=list(SET_UPS), choices=SET_UPS, metavar="COMMAND")
    arguments = parser.parse_args()
    if arguments.through:
        return 1 if through(arguments.commands, arguments.examples) else 0
    words = [sys.executable, "-m", "pytest", "-q", "-n", "0", *FILES]
    environment = {**os.environ, "FUZZ_EXAMPLES": str(arguments.examples), "PYTHONPATH": str(ROOT)}
    return subprocess.run(words, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())

"""The console scripts `scarpsim` and `simulate`: they find the command, and turn every error into a message and an exit code.

Nothing heavy is imported here or at the top of a command's file, so that `--help` is instant.
"""

from __future__ import annotations

import argparse
import errno
import os
import sys
import tempfile
import traceback
from importlib import metadata
from typing import Protocol

from pipeline.cli import calibrate, compare, dataset, detect, doctor, evaluate, gap, icp_study, init, inspect, train
from pipeline.cli import simulate as simulate_command
from pipeline.cli.parser import Parser
from scene.errors import InputError, nearest

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
_BAD_PLACES = {
    errno.ENOSPC: "make room, or choose another folder with --out",
    errno.EDQUOT: "make room, or choose another folder with --out",
    errno.EACCES: "check the permissions, or choose another folder with --out",
    errno.EROFS: "choose another folder with --out",
}
"""What a person can do about an operating system's error, by its number."""


class Command(Protocol):
    """A command's module: what its help says, its arguments, and what it does."""

    SUMMARY: str
    EXAMPLE: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None: ...

    def run(self, arguments: argparse.Namespace) -> int:
        """Carry the command out; returns the exit code. It may set `arguments.kept`, what an interrupt leaves usable."""
        ...


COMMANDS: dict[str, Command] = {
    "simulate": simulate_command,
    "inspect": inspect,
    "compare": compare,
    "icp-study": icp_study,
    "calibrate": calibrate,
    "dataset": dataset,
    "gap": gap,
    "train": train,
    "detect": detect,
    "evaluate": evaluate,
    "init": init,
    "doctor": doctor,
}


def main(argv: list[str] | None = None) -> int:
    """`scarpsim COMMAND ...`; returns the exit code."""
    words = sys.argv[1:] if argv is None else argv
    name = words[0] if words else ""
    if name in COMMANDS:
        return _carry_out(f"scarpsim {name}", COMMANDS[name], words[1:])
    if name in ("-h", "--help", ""):
        print(_overview())
        return DONE if name else WRONG_INPUT
    if name == "--version":
        print(f"scarpsim {metadata.version('scarpsim')}")
        return DONE
    hint = nearest(name, [*COMMANDS, "--help", "--version"]) or f"allowed: {', '.join(COMMANDS)}"
    return _complain(f"scarpsim: there is no command '{name}'; {hint}", WRONG_INPUT)


def simulate(argv: list[str] | None = None) -> int:
    """`simulate ...`, the same as `scarpsim simulate ...`."""
    return _carry_out("simulate", simulate_command, sys.argv[1:] if argv is None else argv)


def _overview() -> str:
    lines = "\n".join(f"  {name:<12}{command.SUMMARY}" for name, command in COMMANDS.items())
    return f"""usage: scarpsim COMMAND ...

Simulates what a stereo pair and a laser scanner measure on a rock wall.

commands:
{lines}

`scarpsim COMMAND --help` explains one.

example:
{simulate_command.EXAMPLE}"""


def _carry_out(prog: str, command: Command, words: list[str]) -> int:
    """Run one command; the only place where errors become exit codes."""
    arguments = argparse.Namespace(debug="--debug" in words, kept="")
    try:
        parser = Parser(prog, command.SUMMARY, command.EXAMPLE)
        command.add_arguments(parser)
        parser.add_argument("--debug", action="store_true", help="show the traceback of an unexpected error")
        arguments = parser.parse(words)
        return command.run(arguments)
    except SystemExit as stop:  # argparse, after --help
        return int(stop.code or DONE)
    except InputError as error:
        return _complain(str(error), WRONG_INPUT)
    except KeyboardInterrupt:
        kept = getattr(arguments, "kept", "")
        return _complain(f"interrupted; {kept}" if kept else "interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except ImportError as error:
        return _complain(f"a library does not load ({error}); `scarpsim doctor` says what is missing", FAILED)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _BAD_PLACES:
            reason = f"{error.filename or 'output'}: {error.strerror}; {_BAD_PLACES[error.errno]}"
            return _complain(reason, WRONG_INPUT)
        return _unexpected(error, show=arguments.debug)


def _complain(message: str, code: int) -> int:
    print(f"error: {message}", file=sys.stderr)
    return code


def _unexpected(error: Exception, *, show: bool) -> int:
    """Report a fault of the program's own: one line, and the traceback where --debug asks for it or else in a file."""
    text = "".join(traceback.format_exception(error))
    summary = " ".join(f"{type(error).__name__}: {error}".split())
    if show:
        print(text, file=sys.stderr, end="")
        return _complain(summary, FAILED)
    try:
        with tempfile.NamedTemporaryFile("w", prefix="scarpsim_error_", suffix=".txt", delete=False) as file:
            file.write(text)
        where = f"the traceback is in {file.name}"
    except OSError:
        where = "run it again with --debug to see the traceback"
    return _complain(f"unexpected fault of the program, {summary}; {where}", FAILED)

"""Run the console scripts `scarpsim` and `simulate`: find the command and turn errors into a message and an exit status.

To keep `--help` fast, neither this module nor the top level of a command's module imports anything heavy.
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import sys
import tempfile
import traceback
from contextlib import nullcontext, redirect_stdout, suppress
from importlib import metadata
from pathlib import Path
from typing import Protocol

from pipeline.cli import (
    calibrate,
    compare,
    completion,
    dataset,
    detect,
    doctor,
    evaluate,
    export,
    gap,
    icp_study,
    init,
    inspect,
    measurement,
    monitor,
    schema,
    surface,
    train,
    view,
)
from pipeline.cli import simulate as simulate_command
from pipeline.cli.command_output import CommandOutput, as_json
from pipeline.cli.interrupt import INTERRUPTED, exit_on_second_interrupt
from pipeline.cli.parser import Parser
from scene.common.errors import InputError, OutsideError, nearest, one_line

DONE, FAILED, WRONG_INPUT = 0, 1, 2
"""Exit statuses."""
_REMEDIES = {
    errno.ENOSPC: "make room, or choose another folder with --out",
    errno.EDQUOT: "make room, or choose another folder with --out",
    errno.EACCES: "check the permissions, or choose another folder with --out",
    errno.EROFS: "choose another folder with --out",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ELOOP: "give the file or folder itself",
    errno.ENOTDIR: "give a path that leads through folders",
}
"""What the user can do about an error of the operating system, by its number."""


class Command(Protocol):
    """Interface of the module of one `scarpsim` command.

    SUMMARY is a sentence for the help and EXAMPLE a command line in it. `add_arguments` declares the arguments; `run` does the
    work.
    """

    SUMMARY: str
    EXAMPLE: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the command's arguments and options on its parser."""
        ...

    def run(self, arguments: argparse.Namespace) -> CommandOutput:
        """Run the command with its parsed arguments and return what it prints.

        It may set `arguments.kept` to a sentence that says which results remain usable after an interrupt.
        """
        ...


COMMANDS: dict[str, Command] = {
    "simulate": simulate_command,
    "inspect": inspect,
    "compare": compare,
    "icp-study": icp_study,
    "calibrate": calibrate,
    "dataset": dataset,
    "monitor": monitor,
    "measurement": measurement,
    "gap": gap,
    "train": train,
    "detect": detect,
    "evaluate": evaluate,
    "view": view,
    "export": export,
    "surface": surface,
    "init": init,
    "schema": schema,
    "completion": completion,
    "doctor": doctor,
}


def main(argv: list[str] | None = None) -> int:
    """Run `scarpsim COMMAND ...` and return the exit status.

    argv: the words after `scarpsim`; by default those of the process.
    """
    words = sys.argv[1:] if argv is None else argv
    name = words[0] if words else ""
    if name in COMMANDS:
        return _run_command(f"scarpsim {name}", COMMANDS[name], words[1:])
    if name in ("-h", "--help", ""):
        print(_overview())
        return DONE if name else WRONG_INPUT
    if name == "--version":
        print(f"scarpsim {metadata.version('scarpsim')}")
        return DONE
    hint = nearest(name, [*COMMANDS, "--help", "--version"]) or f"allowed: {', '.join(COMMANDS)}"
    return _print_error(f"scarpsim: there is no command '{name}'; {hint}", WRONG_INPUT)


def simulate(argv: list[str] | None = None) -> int:
    """Run the command `simulate`, short for `scarpsim simulate`, and return the exit status.

    argv: the words after `simulate`; by default those of the process.
    """
    return _run_command("simulate", simulate_command, sys.argv[1:] if argv is None else argv)


def _overview() -> str:
    """Return the text of `scarpsim --help`."""
    lines = "\n".join(f"  {name:<12}{command.SUMMARY}" for name, command in COMMANDS.items())
    return f"""usage: scarpsim COMMAND ...

Simulates what a stereo pair and a laser scanner measure on a rock wall.

commands:
{lines}

`scarpsim COMMAND --help` explains a command.

example:
{simulate_command.EXAMPLE}

exit status: 0 done; 2 the input or the config is wrong (one message says what is wrong, where, what is allowed and what to do);
1 any other failure, also if `doctor` or `dataset verify --report-only` found a problem; 130 interrupted"""


def command_parser(prog: str, command: Command) -> Parser:
    """Return the argument parser of one command.

    prog: how the help calls the command, such as "scarpsim gap". command: the command's module.
    """
    parser = Parser(prog, command.SUMMARY, command.EXAMPLE)
    command.add_arguments(parser)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an unexpected error")
    return parser


def _run_command(prog: str, command: Command, words: list[str]) -> int:
    """Run one command, print what it returns, and return the exit status.

    With --json, stdout gets exactly one document, also for an error, and everything else goes to stderr.
    """
    arguments = argparse.Namespace(debug="--debug" in words, kept="")
    _escape_unprintable_characters()
    as_document = "--json" in words
    try:
        parser = command_parser(prog, command)
        arguments = parser.parse(words)
        _check_current_folder()
        as_document = getattr(arguments, "json", False)
        ended = exit_on_second_interrupt(lambda: arguments.kept or "no results were kept")
        with redirect_stdout(sys.stderr) if as_document else nullcontext(), ended:
            answer = command.run(arguments)
            text = as_json(answer.document()) if as_document else answer.text
        print(text)
        return answer.code
    except SystemExit as stop:  # raised by argparse after --help
        return int(stop.code or DONE)
    except BrokenPipeError:  # the reader of our output ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (Exception, KeyboardInterrupt) as error:
        message, code = _message_and_exit_code(error, arguments)
        if as_document:
            print(as_json({"error": message, "exit_status": code}))
        return _print_error(message, code)


def _check_current_folder() -> None:
    """Raise InputError if the current folder was deleted, because C libraries abort there."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise InputError("the current folder no longer exists", remedy="cd to another folder") from None


def _escape_unprintable_characters() -> None:
    """Print characters that the terminal's encoding lacks as escapes, because file names may contain any bytes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _message_and_exit_code(error: BaseException, arguments: argparse.Namespace) -> tuple[str, int]:
    """Return the message and the exit status of an error. Only here do errors become exit statuses."""
    if isinstance(error, InputError):
        return str(error), WRONG_INPUT
    if isinstance(error, OutsideError):
        return str(error), FAILED
    if isinstance(error, KeyboardInterrupt):
        kept = getattr(arguments, "kept", "")
        return f"interrupted; {kept}" if kept else "interrupted", INTERRUPTED
    if isinstance(error, ImportError):
        return f"a library does not load ({error}); `scarpsim doctor` says what is missing", FAILED
    if isinstance(error, OSError) and error.errno in _REMEDIES:
        where = one_line(str(error.filename or "output"))
        return f"{where}: {error.strerror}; {_REMEDIES[error.errno]}", WRONG_INPUT
    if (
        isinstance(error, MemoryError) or type(error).__name__ == "ResourceExhaustedError"
    ):  # TensorFlow's, which is not loaded here
        problem = one_line(str(error)) or "the system refused more"
        return f"not enough memory ({problem}); use larger pixels or steps, or less data at a time", WRONG_INPUT
    return _unexpected(error, show=arguments.debug), FAILED


def _print_error(message: str, code: int) -> int:
    """Print an error message on stderr and return the exit status `code`."""
    with suppress(OSError):  # nobody reads stderr, or the disk is full
        print(f"error: {message}", file=sys.stderr, flush=True)
    return code


def _unexpected(error: BaseException, *, show: bool) -> str:
    """Return an internal error in one line; its traceback goes to stderr with --debug, otherwise to a file."""
    text = "".join(traceback.format_exception(error))
    summary = " ".join(f"{type(error).__name__}: {error}".split())
    if show:
        print(text, file=sys.stderr, end="")
        return summary
    try:
        with tempfile.NamedTemporaryFile("w", prefix="scarpsim_error_", suffix=".txt", delete=False) as file:
            file.write(text)
        where = f"the traceback is in {file.name}"
    except OSError:
        where = "run it again with --debug to see the traceback"
    return f"internal error, {summary}; {where}"

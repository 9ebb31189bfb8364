"""`scarpsim completion`: print the script with which a shell completes commands, options and their values."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import one_of

SUMMARY = "print the completion script of a shell"
EXAMPLE = """  scarpsim completion bash > ~/.local/share/bash-completion/completions/scarpsim
  scarpsim completion zsh > ~/.zfunc/_scarpsim        # with fpath+=~/.zfunc before compinit in ~/.zshrc
  scarpsim completion fish > ~/.config/fish/completions/scarpsim.fish
  scarpsim completion bash --script simulate > ~/.local/share/bash-completion/completions/simulate"""
_SHELLS, _SCRIPTS = ("bash", "zsh", "fish"), ("scarpsim", "simulate")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim completion` on its parser."""
    parser.add_argument("shell", type=one_of(*_SHELLS), metavar="|".join(_SHELLS), help="your shell")
    parser.add_argument(
        "--script",
        type=one_of(*_SCRIPTS),
        default=_SCRIPTS[0],
        metavar="|".join(_SCRIPTS),
        help="command to complete (default: scarpsim)",
    )


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Return the script that completes commands in a shell."""
    import shtab

    from pipeline.cli.main import COMMANDS, command_parser

    if arguments.script == "simulate":
        whole: argparse.ArgumentParser = command_parser("simulate", COMMANDS["simulate"])
        _add_completions(whole)
    else:
        whole = argparse.ArgumentParser("scarpsim", description="simulates what sensors measure on a rock wall")
        whole.add_argument("--version", action="store_true", help="print the version")
        below = whole.add_subparsers(dest="command")
        for name, command in COMMANDS.items():
            one = below.add_parser(name, help=command.SUMMARY)
            command.add_arguments(one)
            one.add_argument("--debug", action="store_true", help="show the traceback of an unexpected error")
            _add_completions(one)
    return CommandOutput(shtab.complete(whole, arguments.shell).rstrip("\n"))


def _add_completions(parser: argparse.ArgumentParser) -> None:
    """Tell shtab which words an argument allows and which arguments are paths; it cannot read this from argparse's types."""
    import shtab

    for action in parser._actions:
        words = getattr(action.type, "allowed", None)
        if words:
            action.choices = words
        elif action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]

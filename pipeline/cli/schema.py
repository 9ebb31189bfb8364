"""`scarpsim schema`: print the JSON schema of a config file, for editors."""

from __future__ import annotations

import argparse

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import one_of

SUMMARY = "print the JSON schema of a config file, for editors"
EXAMPLE = """  scarpsim schema simulation > scarpsim.schema.json
  scarpsim schema dataset"""
_KINDS = ("simulation", "dataset", "detector", "scanner", "model", "measurement")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim schema` on its parser."""
    parser.add_argument(
        "kind",
        type=one_of(*_KINDS),
        nargs="?",
        default="simulation",
        metavar="KIND",
        help=f"{', '.join(_KINDS)} (default: simulation)",
    )


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Return the JSON schema of one kind of config, with which editors check and complete it."""
    from pipeline.cli.json_schema import schema_text

    return CommandOutput(schema_text(arguments.kind).rstrip("\n"))

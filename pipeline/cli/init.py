"""`scarpsim init`: write a complete, commented config to start from."""

from __future__ import annotations

import argparse
from pathlib import Path

SUMMARY = "write a complete config with every key explained"
EXAMPLE = """  scarpsim init --site glendale --out my_site.yaml
  simulate --sensor tls --config my_site.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--site", metavar="NAME", help="start from a bundled site, such as glendale (default: the demo)")
    parser.add_argument("--out", type=Path, default=Path("scarpsim.yaml"), metavar="FILE", help="default: %(default)s")


def run(arguments: argparse.Namespace) -> int:
    from pipeline.bundled import bundled_config
    from pipeline.commented import commented_yaml
    from pipeline.config import SimulationConfig
    from scene.config import load_yaml, parse
    from scene.errors import InputError

    source = bundled_config("sites", arguments.site) if arguments.site else bundled_config("", "demo")
    text = commented_yaml(parse(SimulationConfig, load_yaml(source) or {}, str(source)))
    try:
        with arguments.out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError("exists already", where=str(arguments.out), remedy="choose another name with --out") from None
    except (FileNotFoundError, NotADirectoryError):
        raise InputError("there is no such folder", where=str(arguments.out.parent), remedy="make it first") from None
    print(f"wrote {arguments.out}; run it with: simulate --sensor tls --config {arguments.out}")
    return 0

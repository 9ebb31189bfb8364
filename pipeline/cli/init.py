"""`scarpsim init`: write a short config to start from, all further keys in its comments."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options
from scene.common.errors import InputError

SUMMARY = "write a short config to start from, with every further key in a comment"
EXAMPLE = """  scarpsim init --site glendale --scanner riegl_vz400i --out my_site.yaml
  simulate --sensor tls --config my_site.yaml
  scarpsim init --mesh wall.ply --cameras cameras.xml --out my_site.yaml
  scarpsim init --dataset small --out my_set.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--site", metavar="NAME", help="start from a bundled site, such as glendale (default: the demo)")
    words = "with the wall of this mesh file, or of several that make up the scene, in survey coordinates"
    parser.add_argument("--mesh", type=Path, metavar="FILE", nargs="+", help=words)
    parser.add_argument(
        "--cameras", type=Path, metavar="FILE", help="with the pair of this file: Metashape, COLMAP or cameras.yaml"
    )
    parser.add_argument("--scanner", metavar="NAME", help="with this scanner, such as riegl_vz400i, its noise and its beam")
    parser.add_argument("--dataset", metavar="NAME", help="the config of a data set instead, such as small")
    parser.add_argument("--out", type=Path, default=Path("scarpsim.yaml"), metavar="FILE", help="default: %(default)s")
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Write the config and its JSON schema."""
    out = arguments.out
    if arguments.dataset and (arguments.site or arguments.scanner or arguments.mesh or arguments.cameras):
        raise InputError("stands beside --site or --scanner", where="--dataset", remedy="a data set's walls name their sites")
    kind = "dataset" if arguments.dataset else "simulation"
    meshes = [_relative_to_config(out, path) for path in arguments.mesh or ()]
    cameras = _relative_to_config(out, arguments.cameras) if arguments.cameras else ""
    made = _data_set_text(arguments.dataset) if arguments.dataset else ""
    text = made or simulation_text(arguments.site, arguments.scanner, meshes, cameras)
    from pipeline.cli.json_schema import schema_line, schema_name, schema_text
    from pipeline.formats.files.atomic import write_text

    schema = out.parent / schema_name(kind)
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(schema_line(kind) + text)
    except FileExistsError:
        raise InputError("exists already", where=str(out), remedy="choose another name with --out") from None
    except (FileNotFoundError, NotADirectoryError):
        raise InputError("there is no such folder", where=str(out.parent), remedy="make it first") from None
    write_text(schema, schema_text(kind))
    command = f"scarpsim dataset {out} --out my_set" if arguments.dataset else f"simulate --sensor tls --config {out}"
    told = f"wrote {out} and, for editors, {schema}; run it with: {command}"
    return CommandOutput(told, lambda: {"file": str(out), "schema": str(schema), "command": command})


def _relative_to_config(out: Path, path: Path) -> str:
    """The path of an input as the config in `out` names it: relative to its folder. Raises InputError where there is none."""
    if not path.exists():
        raise InputError("there is no such file", where=str(path), remedy="check the path")
    return os.path.relpath(path.resolve(), out.parent.resolve())


def simulation_text(site: str | None, scanner: str | None, meshes: Sequence[str] = (), cameras: str = "") -> str:
    """Return a config that starts from a bundled site, with another scanner, wall (one file or several) or cameras (file)."""
    from pipeline.config.bundled import bundled_config
    from pipeline.config.commented import commented_yaml
    from pipeline.config.simulation import SimulationConfig
    from scene.common.config import load_yaml, parse

    source = bundled_config("sites", site) if site else bundled_config("", "demo")
    values = load_yaml(source)
    mesh = meshes[0] if len(meshes) == 1 else list(meshes)
    values |= ({"wall": {"mesh": mesh}} if mesh else {}) | ({"cameras": {"file": cameras}} if cameras else {})
    if scanner:
        models = [model for model in values["sensor"] if model["sensor"] != "tls"]
        values |= {"scanner": {"preset": scanner, **values["scanner"]}, "sensor": models}
    return commented_yaml(parse(SimulationConfig, values, str(source)), values)


def _data_set_text(name: str) -> str:
    from pipeline.config.bundled import bundled_config

    return bundled_config("datasets", name).read_text(encoding="utf-8")

"""`scarpsim init`: write a short config to start from, with all further keys as comments."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options
from scene.common.errors import InputError

SUMMARY = "write a short config to start from, with all further keys as comments"
EXAMPLE = """  scarpsim init --site glendale --scanner riegl_vz400i --out my_site.yaml
  simulate --sensor tls --config my_site.yaml
  scarpsim init --mesh wall.ply --cameras cameras.xml --out my_site.yaml
  scarpsim init --dataset small --out my_set.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim init` on its parser."""
    parser.add_argument("--site", metavar="NAME", help="start from a bundled site, such as glendale (default: the demo)")
    words = "take the wall from this mesh file, or from the several that make up the scene, in survey coordinates"
    parser.add_argument("--mesh", type=Path, metavar="FILE", nargs="+", help=words)
    parser.add_argument(
        "--cameras", type=Path, metavar="FILE", help="take the camera pair from this file: Metashape, COLMAP or cameras.yaml"
    )
    parser.add_argument("--scanner", metavar="NAME", help="take scanner, noise and beam from this preset, such as riegl_vz400i")
    parser.add_argument("--dataset", metavar="NAME", help="write the config of a data set instead, such as small")
    parser.add_argument(
        "--out", type=Path, default=Path("scarpsim.yaml"), metavar="FILE", help="config to write (default: %(default)s)"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Write a commented config to start from, and the JSON schema with which editors check it."""
    out = arguments.out
    if arguments.dataset and (arguments.site or arguments.scanner or arguments.mesh or arguments.cameras):
        raise InputError(
            "the option cannot be combined with --site, --scanner, --mesh or --cameras",
            where="--dataset",
            remedy="leave --dataset out, or name the sites of the walls in the data set's config",
        )
    kind = "dataset" if arguments.dataset else "simulation"
    meshes = [_relative_to_config(out, path) for path in arguments.mesh or ()]
    cameras = _relative_to_config(out, arguments.cameras) if arguments.cameras else ""
    _check_inputs(arguments)
    made = _data_set_text(arguments.dataset) if arguments.dataset else ""
    text = made or simulation_text(arguments.site, arguments.scanner, meshes, cameras)
    from pipeline.cli.json_schema import schema_line, schema_name, schema_text
    from pipeline.formats.files.atomic import write_text

    schema = out.parent / schema_name(kind)
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(schema_line(kind) + text)
    except FileExistsError:
        raise InputError("the file exists already", where=str(out), remedy="choose another name with --out") from None
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            "there is no such folder", where=str(out.parent), remedy="create this folder first, or choose another one with --out"
        ) from None
    write_text(schema, schema_text(kind))
    command = f"scarpsim dataset {out} --out my_set" if arguments.dataset else f"simulate --sensor tls --config {out}"
    told = f"wrote {out} and, for editors, {schema}; run it with: {command}"
    return CommandOutput(told, lambda: {"file": str(out), "schema": str(schema), "command": command})


def _relative_to_config(out: Path, path: Path) -> str:
    """Return the path of an input relative to the folder of the config `out`. Raises InputError if the file does not exist."""
    if not path.exists():
        raise InputError("there is no such file", where=str(path), remedy="give the path of an existing file")
    return os.path.relpath(path.resolve(), out.parent.resolve())


def _check_inputs(arguments: argparse.Namespace) -> None:
    """Raise InputError if a mesh, the cameras, the site or the scanner cannot be used."""
    if arguments.site:
        with _named("--site"):
            from pipeline.config.bundled import bundled_config

            bundled_config("sites", arguments.site)
    if arguments.scanner:
        with _named("--scanner"):
            from pipeline.config.presets import read_preset

            read_preset(arguments.scanner)
    for path in arguments.mesh or ():
        with _named("--mesh"):
            from scene.walls.imported import check_mesh_file

            check_mesh_file(path)
    if arguments.cameras:
        with _named("--cameras"):
            from pipeline.formats.cameras.camera_files import read_oriented
            from pipeline.formats.cameras.cameras import read_cameras_yaml

            _ = read_oriented(arguments.cameras) or read_cameras_yaml(arguments.cameras)


@contextmanager
def _named(option: str) -> Iterator[None]:
    """Within the `with` block, put the name of an option before the place that an InputError names."""
    try:
        yield
    except InputError as error:
        raise InputError(error.what, where=f"{option}: {error.where}", allowed=error.allowed, remedy=error.remedy) from None


def simulation_text(site: str | None, scanner: str | None, meshes: Sequence[str] = (), cameras: str = "") -> str:
    """Return the text of a config that starts from a bundled site.

    Parameters
    ----------
    site : str or None
        Name of the bundled site. None: the demo.
    scanner : str or None
        Scanner preset to use instead of the site's scanner.
    meshes : sequence of str
        Mesh files of the wall to use instead of the site's.
    cameras : str
        File of the camera pair to use instead of the site's, or empty.
    """
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
    """Return the text of a bundled data set's config."""
    from pipeline.config.bundled import bundled_config

    return bundled_config("datasets", name).read_text(encoding="utf-8")

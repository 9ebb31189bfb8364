"""The config files that come with the program: `configs/` of a checkout, `pipeline/configs/` of an installed wheel."""

from __future__ import annotations

from pathlib import Path

from scene.errors import InputError, nearest

_PLACES = (Path(__file__).parents[1] / "configs", Path(__file__).parents[2] / "configs")


def configs_folder() -> Path:
    """The folder of the bundled configs; raises InputError where the installation lacks it."""
    for place in _PLACES:
        if place.is_dir():
            return place
    raise InputError("the bundled configs are missing", where=str(_PLACES[0]), remedy="install scarpsim again")


def bundled_config(kind: str, name: str) -> Path:
    """The file of the bundled config `name` of a `kind` (a subfolder, such as "sites"; "" for the top, as of demo.yaml).

    Raises InputError with the nearest name where there is none of that name.
    """
    folder = configs_folder() / kind
    path = folder / f"{name}.yaml"
    if path.is_file() and path.parent == folder:
        return path
    known = sorted(found.stem for found in folder.glob("*.yaml"))
    raise InputError(
        f"there is no '{name}'", where=f"configs/{kind}".rstrip("/"), allowed=", ".join(known), remedy=nearest(name, known)
    )


def config_path(kind: str, given: Path) -> Path:
    """`given` itself or, where nothing is there, the bundled config that it names: `glendale`, or by its path in a checkout,
    `configs/sites/glendale.yaml`, which an installed wheel has elsewhere.

    Raises InputError with the nearest name where a bare word is neither a file nor a bundled config of `kind`.
    """
    if given.exists():
        return given
    if given.parts[:1] == ("configs",):
        bundled = configs_folder().joinpath(*given.parts[1:])
        return bundled if bundled.is_file() else given
    if given.suffix or len(given.parts) > 1:
        return given
    try:
        return bundled_config(kind, given.name)
    except InputError as error:
        what = "is no file, and no bundled config has that name"
        raise InputError(what, where=str(given), allowed=error.allowed, remedy=error.remedy) from None

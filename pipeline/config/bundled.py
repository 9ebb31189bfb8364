"""Find the config files that come with the program: `configs/` in a checkout, `pipeline/configs/` in an installed wheel."""

from __future__ import annotations

from pathlib import Path

from scene.common.errors import InputError, nearest
from scene.common.plug_ins import load_plug_ins

PLUG_INS = {"scanners": "scarpsim.scanners", "noise": "scarpsim.noise", "sites": "scarpsim.sites"}
"""Groups of entry points by which other packages add configs of a kind, each the path of a YAML file."""
_PLACES = (Path(__file__).parents[1] / "configs", Path(__file__).parents[2] / "configs")


def configs_folder() -> Path:
    """Return the folder of the configs that come with scarpsim (sites, scanners, sensor models).

    Raises InputError if the installation lacks it.
    """
    for place in _PLACES:
        if place.is_dir():
            return place
    raise InputError(
        "the bundled configs are missing",
        where=str(_PLACES[0]),
        remedy="run `make setup` in the checkout, or install scarpsim again",
    )


def named_configs(kind: str) -> dict[str, Path]:
    """Return the config files of a kind by name: those that come with the program, and those that other packages add.

    kind: a subfolder of the bundled configs, such as "sites".
    """
    own = {path.stem: path for path in sorted((configs_folder() / kind).glob("*.yaml"))}
    if kind not in PLUG_INS:
        return own
    needs = "the path of a YAML file, as text or Path"
    further = load_plug_ins(PLUG_INS[kind], needs, lambda value: isinstance(value, str | Path) and Path(value).is_file(), own)
    return own | {name: Path(path) for name, path in further.items()}


def bundled_config(kind: str, name: str) -> Path:
    """Return the file of the bundled config `name` of a `kind`.

    kind: a subfolder such as "sites", or "" for the top level with demo.yaml. Raises InputError, with the most similar name, if
    there is none.
    """
    named = named_configs(kind)
    if name in named:
        return named[name]
    known = sorted(named)
    raise InputError(
        f"there is no bundled config '{name}'",
        where=f"configs/{kind}".rstrip("/"),
        allowed=", ".join(known),
        remedy=nearest(name, known) or "choose one of these names",
    )


def config_path(kind: str, given: Path) -> Path:
    """Find the config file that a user names: a path or, if no such file exists, the name of a bundled config.

    kind: a subfolder of the bundled configs, such as "sites", in which a name is looked up. given: what the user wrote: a
    path; a word such as `glendale`; or a path in the source code, such as `configs/sites/glendale.yaml`, which also works
    if the program is installed elsewhere. Raises InputError, with the most similar name, if a word is neither a file nor
    a bundled config of `kind`.
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
        raise InputError(
            "this is no file, and no bundled config has that name",
            where=str(given),
            allowed=error.allowed,
            remedy=error.remedy or "give the path of an existing config",
        ) from None

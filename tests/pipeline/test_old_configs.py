"""Configs of older minor versions still load: each folder of tests/configs_of_versions holds those of one version.

A key that is renamed keeps its old name as an alias; when a minor version comes out, its own complete configs are added
(`scarpsim init`, the `#` of its keys taken away). Nothing in these files is ever changed.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from config_loaders import LOADERS

from pipeline.config.simulation import load_config

FILES = sorted((Path(__file__).parents[1] / "configs_of_versions").glob("*/*.yaml"))


def test_every_kind_is_kept() -> None:
    assert {path.stem for path in FILES} == set(LOADERS)


@pytest.mark.parametrize("path", FILES, ids=[f"{path.parent.name} {path.stem}" for path in FILES])
def test_a_config_of_an_older_version_loads(path: Path) -> None:
    assert LOADERS[path.stem](path)


def test_the_values_of_an_older_config_are_those_it_says() -> None:
    """Not only accepted: a sample of its values arrives."""
    path = next(path for path in FILES if path.parts[-2:] == ("0.1", "simulation.yaml"))
    config = load_config(path, [], None, None)
    assert config.rockfall.count == 1500
    assert config.scanner.name == "RIEGL VZ-400i"
    assert config.tls_model().effects[0].name == "beam_divergence"
    assert config.difference.gsd_m == 0.02

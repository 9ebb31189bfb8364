"""Configs of older minor versions still load: each folder of tests/configs_of_versions holds those of one version.

A renamed key keeps its old name as an alias. When a minor version is released, its complete configs are added (those of `scarpsim
init` with the `#` of all keys removed). These files are never changed.
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
    """The configs are not only accepted: a sample of their values is checked."""
    path = next(path for path in FILES if path.parts[-2:] == ("0.1", "simulation.yaml"))
    config = load_config(path, [], None, None)
    assert config.rockfall.count == 1500
    assert config.scanner.name == "RIEGL VZ-400i"
    assert config.tls_model().effects[0].name == "beam_divergence"
    assert config.difference.gsd_m == 0.02

"""Each command with random damage in arguments and files: exit status 0 or 2, one line of error, nothing left behind.

The commands run in this process up to where their work starts (WORK_STARTS). FUZZ_EXAMPLES sets the number of cases of each
command: 25 here, 500 in benchmarks/fuzz.py, which with --through also goes further and measures time and memory.
"""

from __future__ import annotations

import resource
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_fuzz import QUICK

from benchmarks.bad_inputs.case import tried
from benchmarks.bad_inputs.materials import make_small
from benchmarks.bad_inputs.random_cases import SET_UPS, drawn
from benchmarks.bad_inputs.run import said
from pipeline.cli.main import COMMANDS
from scene.common.errors import InputError

WORK_STARTS = (
    "pipeline.run.simulation:_make_epochs",
    "pipeline.planning.inspect:inspect",
    "pipeline.comparison.comparison:compare",
    "pipeline.icp_study.study:study",
    "pipeline.icp_study.study:simulated_surfaces",
    "pipeline.calibration.calibrate:calibrate_inputs",
    "pipeline.dataset.run:write_dataset_file",
    "pipeline.dataset.combine:_finish",
    "pipeline.monitoring.run:compare_epoch",
    "pipeline.gap.naming.workflow:diagnose",
    "pipeline.gap.survey.identifiability:identifiability",
    "pipeline.detection.products.run:_write",
    "pipeline.export.pictures:save_picture",
    "pipeline.surface.from_cloud:surface_of_cloud",
    "pipeline.view.server:make_server",
)
"""Where work begins after all files are read; there the commands end here as for wrong input."""
_MOST_BYTES = 2e9


@pytest.fixture(scope="module")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz_commands") / "materials"
    make_small(folder)
    return folder


@pytest.fixture
def _stop_where_work_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: Any, **__: Any) -> Any:
        raise InputError("the work would begin here")

    for place in WORK_STARTS:
        module, name = place.split(":")
        monkeypatch.setattr(import_module(module), name, stop)
    monkeypatch.setenv("KERAS_BACKEND", "none")  # is looked for after all else, and not found


def test_every_command_is_drawn() -> None:
    assert set(SET_UPS) == set(COMMANDS)


@pytest.mark.usefixtures("_stop_where_work_starts")
@pytest.mark.parametrize("command", SET_UPS)
def test_a_command_with_odd_words_and_files(command: str, materials: Path, tmp_path: Path) -> None:
    numbers, before = count(), _peak_bytes()

    @QUICK
    @given(data=st.data())
    def answered(data: st.DataObject) -> None:
        outcome = tried(drawn(data.draw, command, materials), materials, tmp_path / str(next(numbers)))
        assert not outcome.problems, f"{said(outcome)}: {outcome.case.words}"

    answered()
    assert _peak_bytes() - before < _MOST_BYTES


def _peak_bytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1e3

"""Every benchmark runs at a tiny size, so that none is forgotten when a signature changes. Its results mean nothing at that size.

A script's constants and the configs that it makes are replaced by smaller ones before its `main` is called in this process, so
that imports and kernels are shared.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from tiny_dataset import tiny as tiny_config
from tiny_dataset import tiny_set

from pipeline.planning import series as planning_series

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "benchmarks"
LIBRARIES = {"measure", "documents", "coverage_contexts", "matcher_cases", "varied", "workshop"}
"""Modules that benchmarks import; they run with them."""
ELSEWHERE = {
    "fuzz": "tests/test_fuzz.py, test_fuzz_commands.py and test_fuzz_records.py run what it runs",
    "bad_inputs/run": "tests/test_bad_inputs.py",
    "bad_inputs/preloaded": "benchmarks/bad_inputs/run.py runs it as a process of its own",
    "gap_ablation/run": "tests/test_gap_ablation.py",
    "gap_ablation/page": "tests/test_gap_ablation.py",
    "gap_ablation/steps": "tests/test_gap_ablation.py",
    "gap_closed_form/run": "tests/test_gap_closed_form.py",
    "gap_monitored": "tests/monitor/test_stable_measurement.py runs the same commands on smaller walls",
    "gap_injections/run": "tests/test_gap_injections.py",
    "gap_second_generator/run": "tests/test_gap_second_generator.py",
    "gap_thresholds": "tests/test_varied.py",
    "gap_cost": "tests/test_gap_cost.py",
    "mutation": "tests/test_mutation.py",
    "performance": "tests/test_performance.py",
    "readers/draw": "tests/test_generated_pages.py",
    "field_reports/run": "tests/test_field_reports.py",
    **dict.fromkeys(
        ("detector", "detector_ablation", "detector_curve", "detector_drawn", "detector_mirrored", "detector_table"),
        "tests/detect/test_detector_benchmarks.py",
    ),
}
"""Scripts that other tests run."""


@dataclass(frozen=True)
class Tiny:
    """How a script is made small.

    words: arguments of its command line; arguments: arguments of its `main`; values: new values of its globals; keys: by the name
    of a config that the script makes, further keywords for it; overrides: overrides of the configs that it loads.
    """

    words: tuple[str, ...] = ()
    arguments: tuple[Any, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)
    keys: dict[str, dict[str, Any]] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()


COARSE_WALL = {"ProceduralWall": {"width_m": 12.0, "height_m": 8.0, "resolution_m": 0.2}}
SMALL_FRAME = {"RigConfig": {"width": 368, "height": 246, "distance_m": 25.0}}
SMALL_SITE = (
    "wall.width_m=10",
    "wall.height_m=6",
    "wall.resolution_m=0.2",
    "rockfall.count=3",
    "cameras.width=368",
    "cameras.height=246",
    "cameras.distance_m=20",
    "scanner.azimuth_step_rad=0.004",
    "scanner.zenith_step_rad=0.004",
    "station.distance_m=20",
    "difference.gsd_m=0.1",
    "depth_map=high",
)
SMALL_KEYS = [each.split("=") for each in SMALL_SITE if "=" in each]
TINY_SERIES = {
    "wall": {"width_m": 8.0, "height_m": 5.0, "resolution_m": 0.08, "seed": 1},
    "station": {"distance_m": 15.0},
    "scanner": {"azimuth_step_rad": 0.002, "zenith_step_rad": 0.002},
    "series": {
        "times": {"start": "2026-03-01", "every_h": 6, "count": 3},
        "rockfall": {"rate_per_day": 8, "volume_m3": {"power_law": {"smallest": 0.02, "largest": 0.05}}},
        "precursor": {},
    },
}
SCRIPTS: dict[str, Tiny] = {
    "calibrate_recovery": Tiny(("--trials", "1", "--out", "recovery")),
    "calibrate_speed": Tiny(
        overrides=(*SMALL_SITE, "cameras.base_m=1", "difference.gsd_m=0.02", "calibration.window_px=16", "calibration.windows=6")
    ),
    "carve": Tiny(values={"CELLS_M": {False: 1.0, True: 1.0}}, keys={"RockfallConfig": {"count": 4}}),
    "dataset": Tiny(("workers", "--rounds", "1")),
    "dataset_noise": Tiny(("small", "--maps", "1")),
    "detectability": Tiny(values={"ROUNDS": 1, "BLOCKS": 4, "STEP_RAD": 2e-3}),
    "detector_whole": Tiny(("--sets", "tiny", "tiny", "--model", "baseline")),
    "difference": Tiny(values={"PIXELS": (70, 30), "SAMPLES": (18, 30)}),
    "epoch": Tiny(arguments=("stereo",), overrides=SMALL_SITE),
    "gap": Tiny(("tls", "--points", "3000")),
    "gap_reference_points": Tiny(
        ("--out", "points"),
        values={"STEP_DEG": 0.5, "PUT": {"an offset of 4 mm": ("range_offset", {"offset_m": 0.004})}},
    ),
    "icp": Tiny(values={"COLUMNS": 40, "ROWS": 30, "REPEATS": 1}),
    "labels": Tiny(
        ("--width", "6", "--height", "4"),
        values={"SIZES": {"large": ("{kind: uniform, low: 0.5, high: 1.0}", 0.1)}, "MODELS": {"none": None}},
    ),
    "laz": Tiny(values={"LINES": 20, "PULSES": 15, "ROUNDS": 1}),
    "m3c2_agreement": Tiny(("--set", *" --set ".join(SMALL_SITE).split())),
    "monitor": Tiny(
        ("--parts", "simulated", "cliff", "--epochs", "1"),
        values={
            "SITES": {"small": ("tls", None, {key.replace(".", "__"): yaml.safe_load(value) for key, value in SMALL_KEYS})},
            "CLIFF": Path("nowhere"),
        },
    ),
    "matcher_noise": Tiny(
        ("--generations", "1", "--motorcycle", "none"),
        values={"FITTED_ON": (("glendale", 7),), "VALIDATED_ON": (("bismantova", 3),), "POLISHING": 1},
    ),
    "niche_depth": Tiny(
        ("--width", "6", "--height", "4", "--maps", "1"), values={"FINE_M": 0.05, "CASES": (("relief", 0.1, 0.1),)}
    ),
    "niche_texture": Tiny(("--set", "tiny")),
    "noise_table": Tiny(("--maps", "2", "--levels", "high", "--out", "noise"), overrides=SMALL_SITE),
    "processes": Tiny(values={"POINTS": 2000, "MAPS_PX": {"detect": (64, 64)}, "DEMO": {}}),
    "reconstruction": Tiny(keys=COARSE_WALL | {"RigConfig": {"width": 1472, "height": 984, "distance_m": 25.0}}),
    "scale": Tiny(("--only", "surface:points"), values={"POINTS": 5000}),
    "series": Tiny(
        ("--speed-epochs", "1"),
        values={
            "CONFIG": TINY_SERIES,
            "LARGE": TINY_SERIES,
        },
    ),
    "sgbm": Tiny(keys=COARSE_WALL | SMALL_FRAME),
    "soak": Tiny(arguments=("tls", 3), overrides=SMALL_SITE),
    "startup": Tiny(values={"_REPEATS": 1}),
    "stereo": Tiny(keys=COARSE_WALL | SMALL_FRAME),
    "tls": Tiny(values={"PULSES": 2000}, keys=COARSE_WALL),
    "tls_beam": Tiny(values={"PULSES": 500}, keys=COARSE_WALL),
    "tls_process": Tiny(values={"PULSES": 2000, "SUB_RAYS": {"one ray": 1}}),
    "tls_steps": Tiny(values={"PULSES": 2000, "WIDE_PULSES": 500, "ROUNDS": 1}),
    "upper_bound": Tiny(("--width", "6", "--height", "4"), values={"WAYS": (("vertices", "low", "relief"),)}),
}


def scripts() -> list[str]:
    """Return all scripts that can be run, by their path below benchmarks/ without the suffix."""
    found = (path.relative_to(FOLDER).with_suffix("") for path in FOLDER.rglob("*.py"))
    runnable = (path for path in found if "__main__" in (FOLDER / path).with_suffix(".py").read_text())
    return sorted(str(path) for path in runnable if str(path) not in LIBRARIES)


def test_no_script_is_left_out() -> None:
    assert set(scripts()) == set(SCRIPTS) | set(ELSEWHERE)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_runs_at_a_tiny_size(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    if "tiny" in SCRIPTS[name].words:
        tiny_set(tmp_path / "tiny")
    monkeypatch.syspath_prepend(str(FOLDER))
    script, tiny = _loaded(name, monkeypatch), SCRIPTS[name]
    _make_small(script, tiny, monkeypatch)
    monkeypatch.setattr(sys, "argv", [str(FOLDER / f"{name}.py"), *tiny.words])
    if name in ("dataset", "dataset_noise"):
        monkeypatch.setattr(script, "load_dataset_config", lambda _: tiny_config())
    if name == "tls_process":
        wall = importlib.import_module("scene.walls.procedural")
        monkeypatch.setattr(wall, "ProceduralWall", _with_keys(wall.ProceduralWall, COARSE_WALL["ProceduralWall"]))
    if name == "matcher_noise":
        cases = sys.modules["matcher_cases"]
        monkeypatch.setattr(cases, "ProceduralWall", _with_keys(cases.ProceduralWall, COARSE_WALL["ProceduralWall"]))
        frame = {"width": 460, "height": 307, "distance_m": 25.0, "base_m": 4.0}
        monkeypatch.setattr(cases, "RigConfig", _with_keys(cases.RigConfig, frame))
    if name == "gap":
        monkeypatch.setattr(script, "empty_kernel_cache", lambda: nullcontext(dict(os.environ)))
    if name == "series":
        monkeypatch.setattr(planning_series, "_ENOUGH", 10)
        monkeypatch.setattr(planning_series, "AVERAGED", (1,))
    if name == "tls":  # starts itself anew with an empty kernel cache, where it would not be small
        monkeypatch.setattr(script.subprocess, "run", lambda *_, **__: script.cold())
    script.main(*tiny.arguments)
    assert capsys.readouterr().out.strip()


def _loaded(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, script)
    spec.loader.exec_module(script)
    return script


def _make_small(script: ModuleType, tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    for constant, value in tiny.values.items():
        assert hasattr(script, constant), constant
        monkeypatch.setattr(script, constant, value)
    for config, keys in tiny.keys.items():
        monkeypatch.setattr(script, config, _with_keys(getattr(script, config), keys))
    if tiny.overrides:
        load = script.load_config
        small = lambda path, overrides, sensor, seed: load(path, [*overrides, *tiny.overrides], sensor, seed)  # noqa: E731
        monkeypatch.setattr(script, "load_config", small)
    if hasattr(script, "medians"):
        timed = script.medians
        monkeypatch.setattr(script, "medians", lambda *works, rounds=1: timed(*works, rounds=1))


def _with_keys(config: Callable[..., Any], keys: dict[str, Any]) -> Callable[..., Any]:
    """Return a wrapper of the config's class that sets these keys in addition."""

    @functools.wraps(config, updated=())
    def small(*given: Any, **named: Any) -> Any:
        return config(*given, **{**named, **keys})

    return small

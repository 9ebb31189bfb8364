"""Simulate what a stereo pair and a laser scanner measure on a rock wall, from Python or from the shell.

    from pipeline import simulate, open_run
    run = simulate("glendale", "tls", rockfall__count=20)
    run[1].difference                                     # xarray.DataArray, m

Each name is loaded when it is first used. The public names are listed in docs/reference/python.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene.common.lazy import lazy_attributes

if TYPE_CHECKING:
    from pipeline.api.building import carve as carve
    from pipeline.api.building import difference as difference
    from pipeline.api.building import make_blocks as make_blocks
    from pipeline.api.building import make_wall as make_wall
    from pipeline.api.building import mesh_points as mesh_points
    from pipeline.api.building import observe as observe
    from pipeline.api.building import open_wall as open_wall
    from pipeline.api.building import place_blocks as place_blocks
    from pipeline.api.building import reconstruct as reconstruct
    from pipeline.api.building import register as register
    from pipeline.api.building import stage as stage
    from pipeline.api.calibrating import Calibration as Calibration
    from pipeline.api.calibrating import calibrate as calibrate
    from pipeline.api.comparing import Comparison as Comparison
    from pipeline.api.comparing import compare as compare
    from pipeline.api.configs import configure as configure
    from pipeline.api.datasets import DataSet as DataSet
    from pipeline.api.datasets import make_dataset as make_dataset
    from pipeline.api.detecting import Detections as Detections
    from pipeline.api.detecting import detect as detect
    from pipeline.api.measuring import Diagnosis as Diagnosis
    from pipeline.api.measuring import Measurement as Measurement
    from pipeline.api.measuring import diagnose as diagnose
    from pipeline.api.measuring import measure as measure
    from pipeline.api.meshes import Mesh as Mesh
    from pipeline.api.monitoring import Monitoring as Monitoring
    from pipeline.api.monitoring import monitor as monitor
    from pipeline.api.pictures import Picture as Picture
    from pipeline.api.planning import Plans as Plans
    from pipeline.api.planning import SensorPlan as SensorPlan
    from pipeline.api.planning import plan as plan
    from pipeline.api.points import Points as Points
    from pipeline.api.runs import Epoch as Epoch
    from pipeline.api.runs import Run as Run
    from pipeline.api.runs import open_run as open_run
    from pipeline.api.runs import simulate as simulate
    from pipeline.api.series_plans import SeriesForecast as SeriesForecast
    from pipeline.api.series_plans import SeriesPlans as SeriesPlans
    from pipeline.api.series_plans import plan_series as plan_series
    from pipeline.config.simulation import SimulationConfig as SimulationConfig
    from pipeline.dataset.loaders import Sample as Sample
    from pipeline.dataset.loaders import Tiles as Tiles

_MODULES = {
    "pipeline.api.building": (
        "carve", "difference", "make_blocks", "make_wall", "mesh_points", "observe", "open_wall", "place_blocks", "reconstruct",
        "register", "stage",
    ),
    "pipeline.api.calibrating": ("Calibration", "calibrate"),
    "pipeline.api.comparing": ("Comparison", "compare"),
    "pipeline.api.configs": ("configure",),
    "pipeline.api.datasets": ("DataSet", "make_dataset"),
    "pipeline.api.detecting": ("Detections", "detect"),
    "pipeline.api.measuring": ("Diagnosis", "Measurement", "diagnose", "measure"),
    "pipeline.api.meshes": ("Mesh",),
    "pipeline.api.monitoring": ("Monitoring", "monitor"),
    "pipeline.api.pictures": ("Picture",),
    "pipeline.api.planning": ("Plans", "SensorPlan", "plan"),
    "pipeline.api.points": ("Points",),
    "pipeline.api.runs": ("Epoch", "Run", "open_run", "simulate"),
    "pipeline.api.series_plans": ("SeriesForecast", "SeriesPlans", "plan_series"),
    "pipeline.config.simulation": ("SimulationConfig",),
    "pipeline.dataset.loaders": ("Sample", "Tiles"),
}  # fmt: skip
__all__ = [name for names in _MODULES.values() for name in names]  # noqa: PLE0604, RUF100
__getattr__, __dir__ = lazy_attributes(__name__, {name: module for module, names in _MODULES.items() for name in names})

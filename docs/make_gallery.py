"""The gallery: for each effect of both registries a page and a difference map.

    python docs/make_gallery.py [SENSOR.NAME ...]

A wall in Glendale's style is observed by a sensor without any noise, once with the effect at its parameters' typical values and
once without it. The map is the difference of the recorded range (stereo: depth), cell by cell, mean of each pixel of 0.25 m.
"""

from __future__ import annotations

import inspect
import io
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from effect_words import STAGES, references, symbols
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from PIL import Image

from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.common.yaml_text import parse_yaml
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.effects import FURTHER_EFFECTS, STEREO_EFFECTS, TLS_EFFECTS
from sensors.effects.base import Effect
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import RigConfig, StationConfig, Target
from sensors.models.sensor_model import StereoModel, TlsModel, TlsNoise
from sensors.signal_chain.observation import Observation
from sensors.stereo.stereo_pair import StereoPair

FOLDER = Path(__file__).parent / "reference" / "effects"
GSD_M = 0.25
SEED = 1
STEREO_QUIET = {"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}
TLS_QUIET = TlsNoise(range_sigma_m=0.0, range_ppm=0.0, angle_sigma_rad=0.0)
SENSORS = {"stereo": "stereo pair", "tls": "laser scanner"}
SCENES = {
    "stereo": "Two Nikon D810 cameras with 50 mm lenses and a base of 28 m see a generated wall from 105 m. The depth"
    " map has medium quality: one cell for 4 x 4 px of the left image.",
    "tls": "A laser scanner sees a generated wall from 105 m, with angular steps of 0.5 mrad.",
}
CELLS = {"stereo": "cells of the depth map", "tls": "pulses"}
_INDEX = """# The effects

An effect is one way in which a real laser scanner or stereo pair differs from an ideal one: a systematic error, or noise. This
catalogue is for users who simulate sensor errors, or who read the name of one in a diagnosis by `scarpsim gap`. Each effect has a
page with its equation, its parameters and a map of what it does to a measurement. If you have a pattern and look for its cause,
begin with [From symptom to cause](../gap/symptoms.md).

`docs/make_gallery.py` writes these pages; do not edit them."""
_ORDER = """## When an effect acts

A simulated sensor applies its effects in stages, in the order of this table, whatever their order in the config. A laser scanner
has the stages from `aim` to `return`, a stereo pair those from `camera` to `point`."""
LEVELS = 17
LOST, GAINED, NOTHING = "#333333", "#2ca02c", "#d0d0d0"


@dataclass(frozen=True)
class Stage:
    """The wall (world frame) and the sensors without noise that look at it."""

    wall: TriangleMesh

    @cached_property
    def frame(self) -> WallFrame:
        """The wall frame, for a sensor at 105 m."""
        return WallFrame.fit(self.wall.vertices, Target(self.wall).stand(105.0, None))

    @cached_property
    def caster(self) -> RayCaster:
        """The ray caster of the wall, wall frame."""
        return RayCaster(self.wall.with_vertices(self.frame.to_wall(self.wall.vertices)))

    @cached_property
    def without(self) -> dict[str, Observation]:
        """What each sensor records without effects."""
        return {sensor: self.observe(sensor, ()) for sensor in SCENES}

    def observe(self, sensor: str, effects: tuple[Effect, ...]) -> Observation:
        """Return what `sensor` (stereo, tls) records with `effects` and no noise."""
        target, random = Target(self.wall), KeyedRandom(SEED)
        if sensor == "stereo":
            model = StereoModel(noise=STEREO_QUIET, effects=effects)
            return StereoPair(RigConfig().place(target), self.frame, model).observe(self.caster, random)
        model = TlsModel(noise=TLS_QUIET, effects=effects)
        station, vertices = StationConfig().place(target), self.caster.mesh.vertices
        return LaserScanner.aimed(station, self.frame, vertices, ScannerConfig(), model).observe(self.caster, random)


@dataclass(frozen=True)
class Comparison:
    """An observation with an effect against the one without it, cell by cell."""

    without: Observation
    acting: Observation

    @property
    def difference(self) -> FloatArray:
        """(h, w) recorded range or depth with the effect minus that without it, m; NaN where one of them is missing."""
        return self.acting.depth - self.without.depth

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(h, w) mask of the cells that only the observation without the effect has."""
        return self.without.valid & ~self.acting.valid

    @property
    def gained(self) -> NDArray[np.bool_]:
        """(h, w) mask of the cells that only the observation with the effect has."""
        return self.acting.valid & ~self.without.valid


def example(effect: type[Effect]) -> Effect:
    """Return the effect at its parameters' typical values, of the left camera where it has one.

    Raises InputError where no typical value differs from null.
    """
    extras = {key: info.json_schema_extra for key, info in effect.model_fields.items()}
    values = {
        key: extra["typical"] for key, extra in extras.items() if isinstance(extra, dict) and extra.get("typical") is not None
    }
    camera = {"camera": "left"} if "camera" in effect.model_fields else {}
    shown = effect(**values, **camera)
    if shown.is_null:
        name = effect.model_fields["name"].default
        raise InputError("has no typical value", where=f"{effect.sensor}.{name}", remedy="give parameter(..., typical=...)")
    return shown


def page(effect: type[Effect], comparison: Comparison) -> str:
    """Return the Markdown page of an effect."""
    shown, name = example(effect), f"{effect.sensor}.{effect.model_fields['name'].default}"
    found = ", or whose diagnosis with `scarpsim gap` names it" if effect not in FURTHER_EFFECTS else ""
    stage = effect.stage.name.lower()
    parts = [
        f"# {name}",
        inspect.cleandoc(sys.modules[effect.__module__].__doc__ or ""),
        f"This page defines one way in which a real {SENSORS[effect.sensor]} departs from an ideal one. It is for users who"
        f" simulate it{found}.",
        f"**What it means:** {effect.means}\n\n**What to do:** {effect.act}",
        f"## Equation\n\n```text\n{inspect.cleandoc(effect.__doc__ or '')}\n```",
        symbols(effect),
        f"When the program simulates a measurement, {STAGES[effect.stage]} (stage [`{stage}`](README.md#when-an-effect-acts)).",
        f"## Parameters\n\n{parameter_table(effect)}",
        "With the default values the effect is off. A unit of `[1]` marks a pure number. The source is where the "
        "parameter comes"
        " from; `empirical` marks a value that no publication gives.",
        f"## In a config\n\n```yaml\n{yaml(shown)}\n```",
        f"## Its difference map\n\n![{name}]({name}.png)",
        f"The map shows the recorded {_quantity(effect)} with the effect of the example minus that without it, as the "
        f"mean over"
        f" the {CELLS[effect.sensor]} in each pixel of {GSD_M:g} m. Red is farther away, as missing rock would be; light grey has"
        f" no data. Where the effect removes or adds values, pixels are dark grey or green. {SCENES[effect.sensor]} There is no"
        " other noise.",
        _figures(effect.sensor, comparison),
        references(effect),
        "[From symptom to cause](../gap/symptoms.md) compares the maps of all effects. The [glossary](../glossary.md) explains"
        " the words. `docs/make_gallery.py` writes this page from the code; do not edit it.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def yaml(shown: Effect) -> str:
    """Return a config section that switches the effect on; check it by reading it again."""
    values = {key: getattr(shown, key) for key in type(shown).model_fields if key != "name"}
    lines = [f"      {key}: {value}" for key, value in values.items() if value != type(shown).model_fields[key].default]
    text = "\n".join(["sensor:", f"  sensor: {shown.sensor}", "  effects:", f"    - name: {shown.name}", *lines])
    model: type[StereoModel | TlsModel] = StereoModel if shown.sensor == "stereo" else TlsModel
    assert parse(model, parse_yaml(text)["sensor"], shown.name).effects == (shown,)
    return text


def parameter_table(effect: type[Effect]) -> str:
    """Return the table of an effect's parameters: meaning, default, bounds and source."""
    rows = ["| parameter | meaning | default | allowed | source |", "|---|---|---|---|---|"]
    for key, info in effect.model_fields.items():
        if key == "name":
            continue
        extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        meaning = info.description or "the camera or cameras that it acts on"
        rows.append(f"| `{key}` | {meaning} | {info.default} | {_allowed(info)} | {extra.get('source', '')} |")
    return "\n".join(rows)


def _allowed(info: Any) -> str:
    bounds = {
        sign: value
        for bound in info.metadata
        for sign in ("ge", "gt", "le", "lt")
        if (value := getattr(bound, sign, None)) is not None
    }
    signs = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    return ", ".join(f"{signs[sign]} {value:g}" for sign, value in bounds.items()) or ", ".join(
        map(str, get_args(info.annotation))
    )


def _quantity(effect: type[Effect]) -> str:
    return "depth" if effect.sensor == "stereo" else "range"


def _figures(sensor: str, comparison: Comparison) -> str:
    values = comparison.difference[np.isfinite(comparison.difference)] * 1e3
    cells, median = comparison.without.valid.sum(), np.median(values)
    spread = 1.4826 * np.median(np.abs(values - median))
    return (
        f"Over all {CELLS[sensor]} the difference has a mean of {values.mean():.2f} mm, a standard deviation of "
        f"{values.std():.2f} mm and"
        f" an NMAD (robust standard deviation, which outliers do not affect) of {spread:.2f} mm. The effect leaves"
        f" {100 * comparison.lost.sum() / cells:.2f} % of them without a value, and gives a value to"
        f" {100 * comparison.gained.sum() / cells:.2f} % that have none without it."
    )


def difference_map(comparison: Comparison, bounds: FloatArray, title: str) -> bytes:
    """Draw the map of the difference that an effect makes, as a PNG of at most 64 colours."""
    grid = Grid.over(bounds, GSD_M)
    points = np.where(comparison.without.valid[..., None], comparison.without.points, comparison.acting.points)
    both = np.isfinite(comparison.difference)
    total, count = (_binned(grid, points[both], weight) for weight in (comparison.difference[both] * 1e3, None))
    mean = np.divide(total, count, out=np.full(grid.shape, np.nan), where=count > 0)
    figure = Figure(figsize=(8.4, 4.6), dpi=100, layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor(NOTHING)
    limit, extent = _limit(mean), (0.0, grid.width * GSD_M, 0.0, grid.height * GSD_M)
    colours = colormaps["RdBu_r"].resampled(LEVELS)
    image = axes.imshow(mean, cmap=colours, vmin=-limit, vmax=limit, extent=extent, interpolation="nearest")
    figure.colorbar(image, ax=axes, label="farther (+), nearer (-), mm", shrink=0.8)
    handles = []
    for cells, colour, word in ((comparison.lost, LOST, "lost"), (comparison.gained, GAINED, "gained")):
        if cells.any():
            most = _binned(grid, points[cells], None) > count
            axes.imshow(_painted(most, colour), extent=extent, interpolation="nearest")
            handles.append(Patch(color=colour, label=f"cells {word}"))
    if handles:
        axes.legend(handles=handles, fontsize=8, loc="upper right")
    axes.set(title=title, xlabel="x, m", ylabel="y, m")
    return _palette_png(figure)


def _binned(grid: Grid, points: FloatArray, weight: FloatArray | None) -> FloatArray:
    """(height, width) sum of `weight` (none: 1) over the (n, 3) points in each pixel."""
    row, column = (np.floor(place).astype(int) for place in (grid.rows(points[:, 1]), grid.columns(points[:, 0])))
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    pixel, size = row[inside] * grid.width + column[inside], grid.width * grid.height
    total = np.bincount(pixel, None if weight is None else weight[inside], size)
    return total.reshape(grid.shape).astype(float)


def _painted(mask: NDArray[np.bool_], colour: str) -> FloatArray:
    """(h, w, 4) `colour` where `mask`, clear elsewhere."""
    rgb = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    return np.where(mask[..., None], [*rgb, 1.0], 0.0)


def _limit(mean: FloatArray) -> float:
    """Return the next of 1, 2, 5 x 10^k mm above 98 % of the absolute values; 1 mm where nothing differs."""
    high = float(np.nanpercentile(np.abs(mean), 98))
    if high < 1e-3:
        return 1.0
    power = 10.0 ** np.floor(np.log10(high))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= high))


def _palette_png(figure: Figure) -> bytes:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    buffer = io.BytesIO()
    picture.quantize(64, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def index() -> str:
    """Return the page that lists all effects' pages."""
    lines = [_INDEX]
    for title, effects in (("Laser scanner", TLS_EFFECTS), ("Stereo pair", (*STEREO_EFFECTS, *FURTHER_EFFECTS))):
        lines += ["", f"## {title}", "", "| effect | what it is |", "|---|---|"]
        for effect in effects:
            name = f"{effect.sensor}.{effect.model_fields['name'].default}"
            lines.append(f"| [{name}]({name}.md) | {inspect.cleandoc(sys.modules[effect.__module__].__doc__ or '')} |")
    lines += ["", _ORDER, "", "| stage | what happens |", "|---|---|"]
    lines += [f"| `{stage.name.lower()}` | {words[0].upper()}{words[1:]}. |" for stage, words in STAGES.items()]
    return "\n".join(lines) + "\n"


def main(wanted: list[str]) -> None:
    """Write the pages and pictures of the effects named, `sensor.name`, or of all."""
    stage = Stage(ProceduralWall(style="glendale", resolution_m=0.1).mesh(KeyedRandom(SEED)))
    for effect in (*TLS_EFFECTS, *STEREO_EFFECTS, *FURTHER_EFFECTS):
        name = f"{effect.sensor}.{effect.model_fields['name'].default}"
        if wanted and name not in wanted:
            continue
        comparison = Comparison(stage.without[effect.sensor], stage.observe(effect.sensor, (example(effect),)))
        (FOLDER / f"{name}.md").write_text(page(effect, comparison))
        (FOLDER / f"{name}.png").write_bytes(difference_map(comparison, stage.caster.mesh.bounds, name))
    (FOLDER / "README.md").write_text(index())


if __name__ == "__main__":
    main(sys.argv[1:])

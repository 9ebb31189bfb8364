"""Write the pages in docs/reference/gap: one for each verdict of `scarpsim gap` with an example, and a table of symptoms.

    PYTHONPATH=tests python docs/make_gap_pages.py [symptoms] [VERDICT ...]

Symptoms: a wall in Glendale's style is observed with and without each effect of the catalogue, as for the gallery. The difference
is registered by a shift and a rotation, as a diagnosis does. The rest is mapped and sorted by the covariate that it depends on.
Examples: measurements by the tests' generator (tests/gap_cases.py), diagnosed.
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from make_gallery import SEED, STEREO_QUIET, TLS_QUIET, Comparison, Stage, example
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from pipeline.config.simulation import SimulationConfig
from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, TlsMeasurement, read_measurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.gap.naming.verdict import MUCH_MOVED, NOT_DESCRIBED, PARTLY_EXPLAINED, STILL_OPEN, TOO_NOISY, VERDICTS
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.report.covariate_ranking import quantile_bins, rank_disagreements
from pipeline.gap.report.figures import gap_figure, maps_figure
from pipeline.gap.report.report import summarise
from pipeline.gap.report.wording import paragraph
from pipeline.gap.residuals.alignment import compute_residuals
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.survey.identifiability import SIMILAR_COSINE, Identifiability, identifiability
from pipeline.gap.survey.survey_views import planned_survey
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.walls.procedural import ProceduralWall
from sensors.effects import STEREO_EFFECTS, TLS_EFFECTS
from sensors.effects.base import Effect
from sensors.models.placement import RigConfig, StationConfig, Target
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.stereo.stereo_pair import REDUCTION

FOLDER = Path(__file__).parent / "reference" / "gap"
_BINS = 24
_DEPENDS = 0.25
"""Share of the variance along a covariate from which the mean counts as depending on it."""
_SMOOTH = 0.3
"""Share of the variance between pixels of some metres from which a map counts as smooth."""
_LOST, _NOTHING, _AT_EDGES = 0.002, 1e-6, 3.0
"""Share of returns lost that counts; what counts as no change; how many times larger residuals are that belong to edges."""
_PIXEL_M = 0.7
_SKIPPED = ("edge_step",)
_WORDS = {
    "range": "range", "azimuth": "azimuth", "zenith": "zenith angle", "incidence": "incidence angle", "intensity": "intensity",
    "line": "scan line", "time": "time", "edge": "distance to depth edges", "depth": "depth", "image_x": "image column",
    "image_y": "image row", "radius": "distance from the image centre", "disparity": "disparity",
    "disparity_fraction": "fraction of the disparity",
}  # fmt: skip


@dataclass(frozen=True)
class Symptom:
    """How an effect shows. kind: key of _KINDS; pattern: in words; left: share that the pose fit leaves."""

    name: str
    kind: str
    pattern: str
    left: float
    picture: bytes


@dataclass(frozen=True)
class View:
    """Residuals of one sensor without any effect, with pose and covariates. cells: (n,) flat index of the cell of each row."""

    residuals: Residuals
    cells: NDArray[np.int64]

    @classmethod
    def of(cls, stage: Stage, sensor: str) -> View:
        """Place the sensor of the gallery in front of the gallery's wall."""
        seen, target = stage.without[sensor], Target(stage.wall)
        valid = np.flatnonzero(seen.valid.ravel())
        points, reference, frame = seen.points.reshape(-1, 3)[valid], stage.caster.mesh, stage.frame
        if sensor == "tls":
            assert seen.intensity is not None
            position, rotation = StationConfig().place(target)
            cloud = PointCloud(points, seen.intensity.ravel()[valid], valid.astype(np.float64))
            station = stage.frame.to_wall(position), stage.frame.rotation @ rotation
            model = TlsModel(noise=TLS_QUIET.model_copy(update={"range_sigma_m": 0.003}))
            measurement: Measurement = TlsMeasurement(cloud=cloud, model=model, station=station, reference=reference, frame=frame)
        else:
            step, columns = REDUCTION["medium"], seen.depth.shape[1]
            pixels = {"pixel_x": (valid % columns + 0.5) * step, "pixel_y": (valid // columns + 0.5) * step}
            noise, cameras = {**STEREO_QUIET, "parallax_sigma_px": 0.3}, RigConfig().place(target)
            measurement = StereoMeasurement(
                cloud=PointCloud(points, extra=pixels), model=StereoModel(noise=noise), cameras=cameras, reference=reference,
                frame=frame,
            )  # fmt: skip
        measurement.__dict__["scene"] = stage.caster
        found = compute_residuals(measurement)
        return cls(found, valid[found.index])


def symptom(view: View, effect: type[Effect], comparison: Comparison, *, on_the_mean: bool) -> Symptom:
    """Return what an effect leaves after registration and what that depends on. on_the_mean: whether it is systematic."""
    name, r = f"{effect.sensor}.{effect.model_fields['name'].default}", view.residuals
    metres = comparison.difference.ravel()[view.cells]
    known = np.isfinite(metres) & r.usable
    value = np.where(np.isfinite(metres), metres, 0.0) / r.unit_m
    kept = known & (np.abs(value) <= 8 * max(1.4826 * float(np.median(np.abs(value[known]))), 1e-9))
    pose = np.linalg.lstsq(r.pose_jacobian[kept], value[kept], rcond=None)[0]
    left = np.where(np.isfinite(metres), value - r.pose_jacobian @ pose, np.nan)
    whole = float(np.linalg.norm(value[kept]))
    share = float(np.linalg.norm(left[kept])) / whole if whole > 0 else 1.0
    lost = comparison.lost.ravel()[view.cells]
    same = float(np.mean(np.abs(left[np.isfinite(left)]) > _NOTHING)) < _LOST
    if same and comparison.gained.sum() > _LOST * len(view.cells):
        kind, pattern = "gained", "there are points where only one camera sees the rock"
    else:
        kind, pattern = _mean_pattern(r, left, kept) if on_the_mean else _other_pattern(r, left, kept, lost)
    return Symptom(name, kind, pattern, share, _picture(r, 1e3 * left * r.unit_m, lost))


def _mean_pattern(r: Residuals, left: FloatArray, kept: NDArray[np.bool_]) -> tuple[str, str]:
    means = {name: _explained(x[kept], left[kept]) for name, x in r.covariates.items() if name not in _SKIPPED}
    best = sorted(means, key=lambda key: -means[key])
    if means[best[0]] > _DEPENDS:
        with_it = [_WORDS[key] for key in best[1:3] if means[key] > 0.9 * means[best[0]]]
        also = f" (and {', '.join(with_it)}, which vary together here)" if with_it else ""
        return "mean", f"the mean follows the {_WORDS[best[0]]}{also}"
    if _explained_by(_pixels(r)[kept], left[kept]) > _SMOOTH:
        return "smooth", "the mean varies smoothly over the wall, but follows no single covariate"
    return "relief", f"the mean differs from facet to facet of the rock; the {_WORDS[best[0]]} explains most of this"


def _other_pattern(r: Residuals, left: FloatArray, kept: NDArray[np.bool_], lost: NDArray[np.bool_]) -> tuple[str, str]:
    covariates = {name: x for name, x in r.covariates.items() if name not in _SKIPPED}
    size, edges = np.abs(left), np.isfinite(left) & ~r.usable
    if lost.mean() > _LOST and np.median(size[kept]) < _NOTHING:
        shares = {name: _explained(x, lost.astype(float)) for name, x in covariates.items()}
        return "lost", f"returns are missing, mostly depending on {_WORDS[max(shares, key=lambda key: shares[key])]}"
    if np.mean(size[edges] > _NOTHING) > _AT_EDGES * np.mean(size[kept] > _NOTHING) or (
        np.median(size[edges]) > _AT_EDGES * np.median(size[kept])
    ):
        return "edges", "large residuals at depth edges and on rough parts, few or small ones elsewhere"
    spreads = {name: _explained(x[kept], size[kept]) for name, x in covariates.items()}
    name = max(spreads, key=lambda key: spreads[key])
    if spreads[name] > 0.02:
        return "spread", f"the mean is unchanged, the standard deviation depends on the {_WORDS[name]}"
    return "spread", "the mean is unchanged, the standard deviation is larger everywhere by the same amount"


def _explained(x: FloatArray, values: FloatArray) -> float:
    """Share of the variance of the values that lies between bins of x."""
    edges, group = quantile_bins(x, _BINS)
    return _explained_by(group, values) if len(edges) > 2 else 0.0


def _explained_by(group: Any, values: FloatArray) -> float:
    _, number = np.unique(group, return_inverse=True)
    count = np.bincount(number)
    mean = np.bincount(number, values) / count
    chance = (len(count) - 1) / len(values)
    return float(np.sum(count * (mean - values.mean()) ** 2) / max(np.sum((values - values.mean()) ** 2), 1e-300)) - chance


def _pixels(r: Residuals) -> NDArray[np.int64]:
    column, row = (np.floor((r.wall_xy[:, axis] - r.wall_xy[:, axis].min()) / (4 * _PIXEL_M)).astype(np.int64) for axis in (0, 1))
    return np.asarray(column + 10_000 * row)


def _picture(r: Residuals, millimetres: FloatArray, lost: NDArray[np.bool_]) -> bytes:
    low = r.wall_xy.min(axis=0)
    column, row = (np.floor((r.wall_xy[:, axis] - low[axis]) / _PIXEL_M).astype(np.int64) for axis in (0, 1))
    shape = int(row.max()) + 1, int(column.max()) + 1
    known = np.isfinite(millimetres)
    pixel, size = row * shape[1] + column, shape[0] * shape[1]
    count = np.bincount(pixel[known], minlength=size)
    mean = np.where(count > 0, np.bincount(pixel[known], millimetres[known], size) / np.maximum(count, 1), np.nan).reshape(shape)
    limit = max(float(np.nanpercentile(np.abs(mean), 97)), 1e-3)
    figure = Figure(figsize=(3.2, 2.1), dpi=75, layout="constrained")
    panel = figure.subplots()
    image = panel.imshow(mean, cmap="RdBu_r", vmin=-limit, vmax=limit, origin="lower", interpolation="nearest")
    gone = np.bincount(pixel[lost], minlength=size).reshape(shape) > 0.5 * np.bincount(pixel, minlength=size).reshape(shape)
    panel.contourf(gone, levels=[0.5, 1.5], colors=["black"]) if gone.any() else None
    panel.set_axis_off()
    figure.colorbar(image, ax=panel, shrink=0.8).ax.tick_params(labelsize=6)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(32, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True
    )
    return buffer.getvalue()


_KINDS = {
    "mean": "The mean of the residual follows one covariate",
    "smooth": "The mean varies smoothly over the wall",
    "relief": "The mean differs between facets of the rock",
    "spread": "The standard deviation differs from the model",
    "edges": "Residuals at depth edges",
    "lost": "Returns are missing",
    "gained": "Points where the model predicts none",
}


def symptoms_page(found: list[Symptom], tables: dict[str, Identifiability]) -> str:
    """Return the page with the table from the pattern in the residual map to the likely effect."""
    lines = [
        "# From symptom to cause",
        "",
        "This page shows how each effect of [the catalogue](../effects/README.md) looks in a map of the residuals. It is for"
        " users who see a pattern in such a map, for example in the report of `scarpsim gap`, and look for its cause. Find the"
        " picture that looks most like yours; its row names the effect. `docs/make_gap_pages.py` writes this page; do not edit "
        "it.",
        "",
        "A *residual* is the measured minus the predicted range or depth, in mm. Each map shows the residuals that one effect of"
        " typical size makes on a generated wall, seen from 105 m without noise, **after a shift and a rotation of the sensor are"
        " fitted**. Lost returns are black. The pattern depends on the wall and on the distance. `scarpsim gap --identifiability"
        " CONFIG` computes which effects can be told apart at your site.",
        "",
        "| column | meaning |",
        "|---|---|",
        "| pattern | what the residuals depend on: their mean, their standard deviation, or where there are none; a facet is a"
        " nearly flat part of the rock |",
        "| left by the pose fit | share of the effect's pattern, as a root mean square, that no shift or rotation of the"
        " sensor imitates |",
        f"| looks like | effects whose pattern has a correlation (cosine) of at least {SIMILAR_COSINE:g} with this one on that"
        " wall; noise, effects at depth edges and missing returns have no fixed pattern, so they are not compared |",
    ]
    for kind, title in _KINDS.items():
        rows = [each for each in found if each.kind == kind]
        if not rows:
            continue
        lines += [
            "",
            f"## {title}",
            "",
            "| residual map | pattern | likely effect | left by the pose fit | looks like |",
            "|---|---|---|---|---|",
        ]
        for each in sorted(rows, key=lambda item: (item.name.partition(".")[0], item.pattern)):
            cell = f"[{each.name}](../effects/{each.name}.md)"
            alike = _alike(each.name, tables[each.name.partition(".")[0]])
            lines.append(
                f"| ![{each.name}](images/{each.name}.png) | {each.pattern} | {cell} | {100 * each.left:.0f} % | {alike} |"
            )
    return "\n".join(lines) + "\n"


def _alike(name: str, table: Identifiability) -> str:
    if name not in table.names:
        return ""
    return ", ".join(table.names[other].partition(".")[2] for other in table.similar_effects(table.names.index(name)))


def make_symptoms() -> None:
    """Write docs/reference/gap/symptoms.md and its pictures."""
    wall = ProceduralWall(style="glendale", resolution_m=0.1)
    stage, config = Stage(wall.mesh(KeyedRandom(SEED))), SimulationConfig(wall=wall, seed=SEED)
    (FOLDER / "images").mkdir(parents=True, exist_ok=True)
    found, tables = [], {}
    for sensor, effects in (("tls", TLS_EFFECTS), ("stereo", STEREO_EFFECTS)):
        view = View.of(stage, sensor)
        tables[sensor] = identifiability(planned_survey(config, "tls" if sensor == "tls" else "stereo"))
        for effect in effects:
            comparison = Comparison(stage.without[sensor], stage.observe(sensor, (example(effect),)))
            name = f"{sensor}.{effect.model_fields['name'].default}"
            found.append(symptom(view, effect, comparison, on_the_mean=name in tables[sensor].names))
            (FOLDER / "images" / f"{found[-1].name}.png").write_bytes(found[-1].picture)
    (FOLDER / "symptoms.md").write_text(symptoms_page(found, tables))


@dataclass(frozen=True)
class Verdict:
    """Content of a verdict's page: when it is given, what to do, an example that gets it (made by tests/gap_cases.py).

    The remark, if there is one, explains the answer to the example.
    """

    when: str
    what_to_do: str
    case: str
    make: Callable[[Path], None]
    remark: str = ""


def _wobble(azimuth: Any, zenith: Any, line: Any) -> Any:
    return 0 * azimuth, 8e-5 * np.sin(2 * np.pi * line / 37 + 1)


def _noisy(scan: Any) -> Any:
    return scan.R + 0.004 * scan.power**-0.5 * scan.rng.standard_normal(len(scan.R))


def _case(**values: Any) -> Callable[[Path], None]:
    from gap_cases import write_scan

    return lambda folder: write_scan(folder, **values)


def verdicts() -> dict[str, Verdict]:
    """Return the verdicts by name, with their examples."""
    return {
        "named": Verdict(
            "An effect passed its test, with a p-value of at most 0.004. It is the only effect of the catalogue that is needed "
            "to explain the disagreement. No other effect explains nearly as much, and no empirical curve explains "
            "clearly more.",
            "Compare the value of the effect with that of the manufacturer or of a calibration. Simulate with model_after.yaml, "
            "which contains the effect.",
            "The mirror of a scanner wobbles by 80 µrad, with a period of 37 scan lines.",
            _case(seed=11, angles=_wobble),
        ),
        "several": Verdict(
            "The conditions of [named](named.md) hold for more than one effect, and each improves the fit beside the others.",
            "Begin with the first effect, because they are sorted by how much they explain. Each effect lists those from which "
            "it cannot be told. If there are any, this measurement does not identify the effect yet.",
            "The mirror of a scanner wobbles as in the example of [named](named.md), and the range noise is larger where less "
            "light returns.",
            _case(seed=12, angles=_wobble, ranges=_noisy),
        ),
        "ambiguous": Verdict(
            "An effect of the catalogue explains the disagreement, but other effects explain it about as well. Their score, a "
            "penalised log-likelihood, is within 3 of the best one, which is a factor of 20 in likelihood. "
            "`cannot_be_told_from` in gap.json lists these effects. It also lists the best two that explain it as well "
            'together; the report joins their names by "together with".',
            "Make the measurement that `split_by` in gap.json names. `scarpsim gap --identifiability` shows what would separate "
            "the effects at your site. You can use model_after.yaml for surveys of this wall from this place, whichever effect "
            "is true. Elsewhere it may be wrong.",
            "All ranges of a scanner are too long by 2 mm. On this wall most of that looks like a shift of the scanner, which is "
            "fitted first. What is left of it resembles what is left of two other effects, which the report names. Which ones "
            "these are depends on the wall, the distance and the noise. [From symptom to cause](symptoms.md) compares patterns "
            "without noise on another wall, so it lists another effect.",
            _case(seed=13, ranges=lambda scan: scan.R + 0.002),
            "The report proposes two measurements, and one of them suffices: targets around the station, whose positions are "
            "known to 1 mm, or a second station.\n\n"
            "The estimate is 1.6 mm, and the true value 2 mm. They differ by 1.3 times the standard error of 0.3 mm, which is "
            "within chance. A misfit remains, but the effect closes more than half of the gap, so the verdict is not "
            "[unknown](unknown.md).",
        ),
        "unknown": Verdict(
            "The model is rejected, but the catalogue does not explain why. There are four cases, and the report begins with "
            "another sentence in each:\n\n"
            "1. *An empirical term describes the misfit.* A curve of one covariate, such as the azimuth or the time, explains "
            "clearly more (a penalised log-likelihood ratio higher by 6) than any effect of the catalogue. The report says the "
            "sentence above. If effects of the catalogue are named beside the curve, it says instead: \"" + PARTLY_EXPLAINED
            + "\"\n"
            "2. *Nothing describes it.* Nothing that was tried passes the test on validation blocks, although the gap exceeds "
            "the floor by more than its uncertainty, or the misfit has a p-value of at most 0.01. The report says: \""
            + NOT_DESCRIBED + "\" It also says where the misfit is and how large, or that disparities jump at the seams of "
            "tiles.\n"
            "3. *The named effects do not help enough.* They leave most of the gap open. Or they leave a misfit with a p-value "
            "of at most 0.01, and the score on validation blocks does not show that they make the gap smaller. The report says, "
            "for example: \"" + STILL_OPEN + "\"\n"
            "4. *The model predicts too much noise.* No effect was found, and only the noise of the model keeps it away from the "
            "floor. The report says: \"" + TOO_NOISY + "\"",
            "See in the report on which covariate the disagreement depends, and in what form. In case 1, model_after.yaml holds "
            "the empirical term, which reproduces the disagreement in simulations, but only within the measured range of the "
            "covariate (`along`, in the unit of the covariate: rad for angles). In case 2 it holds no further effect, in case 3 "
            "the named effects, which explain too little, and in case 4 the lower noise.",
            "The ranges of a scanner jump by 4 mm in the middle of the scan, as after a knock.",
            _case(seed=18, ranges=lambda scan: scan.R + 0.002 * np.where(scan.az > 1.6, 1.0, -1.0)),
            "This is case 1. The second line of the terminal is the empirical term: a curve through 65 points between the "
            "azimuths 0.9508 and 2.049 rad, with values from -1.53 to 3.75 mm.\n\n"
            "The curve is smooth, so it cannot follow a jump exactly: the map on the right still shows two bands beside the "
            "jump. Even so 100 % of the gap is closed. The gap is a mean over all validation blocks, and most of them lie away "
            "from the jump, so the bands hardly change it. The p-value of 0.01 belongs to a test that looks for such local "
            "patterns, and says that something remains.",
        ),
        "no_gap": Verdict(
            "Three things hold. No effect was named. The gap differs from the floor by no more than its uncertainty. The misfit "
            "that remains has a p-value above 0.01. A corrected registration and regions where rock moved (`scene_changes` in "
            "gap.json) are reported, but do not count as a gap. If the model predicts more noise than there is, the report "
            "states the noise that would fit (`lower_noise` under `remaining` in gap.json).",
            "You need not add anything to the model. Smaller effects may be hidden: `detectable` in gap.json and the report list "
            "the size from which each would have shown with a probability of 95 %. If the reference is better than its error was "
            "estimated (`reference_error_m`), say so with `--reference-error`, and smaller effects show.",
            "A scan has noise, a slightly wrong pose, a reference with errors of fractions of a millimetre, and lost returns. "
            "The model allows for all of them.",
            _case(seed=1),
        ),
        "insufficient_data": Verdict(
            "There are three cases:\n\n"
            "1. Fewer than 800 points lie on smooth parts of the reference, where residuals are meaningful.\n"
            "2. No effect was named, and too few points could be kept for validation to measure a gap.\n"
            "3. Much of the wall moved, or the reference shows another place or time, and no effect closes the gap. At least 30 "
            "% of the points lie off the reference together with their neighbours, by both more than 3 predicted standard "
            "deviations and more than 20 mm. The report then says instead: \"" + MUCH_MOVED + "\"",
            "Scan more densely, or use a reference that covers the scan. If much rock moved, add `stable_areas` where nothing "
            "moved to measurement.yaml, or use a reference of the same time.",
            "A scan has angular steps of 0.05 rad, so only few points lie on the wall.",
            _case(seed=1, step_rad=0.05),
        ),
    }  # fmt: skip


_TERMS = """An *effect* is a sensor error of [the catalogue](../effects/README.md). The *gap* is how far the measurement lies from
the model's prediction, *before* and *after* the named effects are in the model. The *floor* is what the model's own noise leaves.
The [glossary](../glossary.md#model-and-measurement) explains further words, and
[how gap reaches its verdict](../../explanation/gap_verdict.md) the tests."""
_PICTURES = """The maps show how much deeper the surface was measured than predicted, and the measured over the predicted standard
deviation. On the left is the model before the named effects, on the right after them. The bar shows the gap on the validation
blocks."""


def verdict_page(name: str, verdict: Verdict, found: GapDiagnosis) -> str:
    """Return the Markdown page of a verdict."""
    pictures = [_PICTURES, f"![maps](images/verdict_{name}.png)", f"![gap](images/gap_{name}.png)"]
    parts = [
        f"# {name}",
        f"`{name}` is a verdict of `scarpsim gap`, which compares a measurement with the model of its sensor. This page is for"
        " users who got it. It says:",
        f"> {VERDICTS[name]}",
        _TERMS,
        f"## When it is given\n\n{verdict.when}",
        f"## What to do\n\n{verdict.what_to_do}",
        f"## Example\n\n{verdict.case} The report says of this simulated measurement:",
        f"> {paragraph(found, rank_disagreements(found))}",
        f"The terminal shows:\n\n```text\n{summarise(found)}\n```",
        *([verdict.remark] if verdict.remark else []),
        *(pictures if found.gap is not None else []),
        "[From symptom to cause](symptoms.md) shows the pattern of each effect. `docs/make_gap_pages.py` writes this page; do not"
        " edit it.",
    ]
    return "\n\n".join(parts) + "\n"


def make_verdicts(wanted: list[str]) -> None:
    """Write docs/reference/gap/<verdict>.md and its figures. Exits if an example gets another verdict than that of its page."""
    (FOLDER / "images").mkdir(parents=True, exist_ok=True)
    for name, verdict in verdicts().items():
        if wanted and name not in wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            verdict.make(Path(folder))
            found = diagnose(read_measurement(Path(folder)))
        if found.verdict != name:
            raise SystemExit(f"the example of {name} is {found.verdict}: {summarise(found)}")
        (FOLDER / f"{name}.md").write_text(verdict_page(name, verdict, found))
        if found.gap is not None:
            (FOLDER / "images" / f"verdict_{name}.png").write_bytes(small_png(maps_figure(found)))
            (FOLDER / "images" / f"gap_{name}.png").write_bytes(small_png(gap_figure(found.gap)))


def small_png(png: bytes) -> bytes:
    """Return the picture at two thirds of its size, as a PNG of 64 colours."""
    buffer = io.BytesIO()
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture = picture.resize((picture.width * 2 // 3, picture.height * 2 // 3), Image.Resampling.LANCZOS)
    picture.quantize(64, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def main(wanted: list[str]) -> None:
    names = [name for name in wanted if name != "symptoms"]
    if not wanted or "symptoms" in wanted:
        make_symptoms()
    if not wanted or names:
        make_verdicts(names)


if __name__ == "__main__":
    main(sys.argv[1:])

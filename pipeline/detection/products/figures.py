"""Draw the detector's pictures: losses over the epochs, detections on a difference map, reliability of scores.

They do not use pipeline.report, which loads the ray tracer's compiler; that and TensorFlow's cannot be in one process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pipeline.detection.evaluation.detections import Detection
from pipeline.detection.evaluation.reliability import Reliability
from pipeline.detection.network.normalisation import nmad
from pipeline.formats.files.atomic import writing
from pipeline.report.plain_text import plain_text
from pipeline.report.words import counted
from scene.geometry.grid import Grid

_PANELS = {"Total": ("loss",), "Class": ("class", "proposal_class"), "Box": ("box", "proposal_box"), "Mask": ("mask",)}
"""Losses that are added up in each panel."""
_TRAINING, _VALIDATION = "#0072B2", "#D55E00"
_SCALE_SIGMAS = 6.0
"""End of the colour scale, in NMADs."""
_WIDEST_PX = 2400
"""Larger maps are drawn with fewer pixels."""
_HIGHEST = 4.0
"""Largest height over width of a drawn map; higher maps are drawn smaller."""
_LOW_IN = 4.5
"""Height of the figure, inches, below which the colour bar is drawn under the map."""
_MOST_NUMBERED = 200
"""Largest number of detections that are numbered."""
_MOST_LINES, _LONGEST_NAME = 12, 40
"""Largest number of groups in a diagram, and of letters of their names in the legend."""
_MOST_MARKED = 30
"""Number of epochs up to which each has a marker, since a single epoch makes no line."""


def write_loss_figure(training: Sequence[Mapping[str, float]], validation: Sequence[Mapping[str, float]], path: Path) -> None:
    """Draw how the losses of a training fall with the epoch: total, class, box and mask; write the figure to `path`.

    training, validation: mean losses by name, for each epoch. Losses of the proposals are added to those of the heads.
    """
    figure = Figure(figsize=(9.6, 6.4), dpi=110, layout="constrained")
    epochs = np.arange(1, len(training) + 1)
    marker = "o" if len(epochs) <= _MOST_MARKED else ""
    for axes, (title, names) in zip(figure.subplots(2, 2).flat, _PANELS.items(), strict=True):
        for history, colour, label in ((training, _TRAINING, "training"), (validation, _VALIDATION, "validation")):
            sums = [sum(losses[name] for name in names) for losses in history]
            axes.plot(epochs, sums, color=colour, label=label, marker=marker, markersize=3)
        axes.set(title=title, xlabel="epoch", ylabel="loss")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.update_datalim([(1, 0)])
        axes.set(xlim=(0.5, len(epochs) + 0.5), ylim=(0, None))
        axes.grid(alpha=0.3)
    figure.axes[0].legend()
    _write(figure, path)


def write_overlay(difference: NDArray[np.float32], grid: Grid, found: Sequence[Detection], path: Path, title: str = "") -> None:
    """Draw a difference map with the outlines of detections; the colour scale ends at six times the map's noise (NMAD).

    Parameters
    ----------
    difference : (h, w) map, m.
    grid : Its raster.
    found : The detections.
    path : PNG file to write.
    title : Title; "": the number of blocks.
    """
    step = max(1, -(-max(difference.shape) // _WIDEST_PX))
    shown = 1e3 * difference[::step, ::step]
    limit = 1e3 * max(_SCALE_SIGMAS * nmad(difference), 1e-4)
    extent = (grid.x_min, grid.x_min + grid.width * grid.gsd, grid.y_max - grid.height * grid.gsd, grid.y_max)
    width = 10.0
    height = 0.9 + width * min(grid.height / grid.width, _HIGHEST) * 0.85
    low = height < _LOW_IN
    figure = Figure(figsize=(width, height + 0.6 * low), dpi=140, layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor("#b5b5b5")
    image = axes.imshow(shown, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent, interpolation="nearest")
    for number, item in enumerate(found, start=1):
        contours, _ = cv2.findContours(item.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            x = grid.x_min + (item.column + contour[:, 0, 0] + 0.5) * grid.gsd
            y = grid.y_max - (item.row + contour[:, 0, 1] + 0.5) * grid.gsd
            axes.plot(np.append(x, x[0]), np.append(y, y[0]), color="black", linewidth=0.9)
        if number <= _MOST_NUMBERED:
            axes.annotate(f"{number}", (float(x.max()), float(y.max())), fontsize=6)
    place: dict[str, Any] = {"location": "bottom", "aspect": 45} if low else {"location": "right"}
    label = "reference minus epoch, mm; missing rock positive"
    bar = figure.colorbar(image, ax=axes, label=label, shrink=0.8, extend=_cut_off(shown, limit), **place)
    bar.ax.tick_params(labelsize=8)
    axes.set(
        xlabel="x along the wall, m",
        ylabel="y up the wall, m",
        title=title or f"{counted(len(found), 'block')} detected, numbered as in the table",
    )
    _write(figure, path)


def write_reliability(groups: Sequence[Reliability], path: Path) -> None:
    """Draw how reliable a detector's scores are: the share of blocks among its detections against their score, as PNG.

    groups: results for groups of images, of which only the first are drawn (they include all images together). Bars are
    standard errors. On the diagonal, scores are probabilities.
    """
    figure = Figure(figsize=(6.4, 5.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.plot((0, 1), (0, 1), color="#808080", linestyle="--", linewidth=1, label="score = probability")
    for each in groups[:_MOST_LINES]:
        x, y, error = ([getattr(one, name) for one in each.classes] for name in ("score", "precision", "error"))
        count = sum(one.detections for one in each.classes)
        axes.errorbar(
            x, y, error, marker="o", markersize=4, linewidth=1, capsize=2, label=f"{each.group:.{_LONGEST_NAME}} ({count:,})"
        )
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="score", ylabel="share that are blocks")
    axes.set_title(f"Reliability of scores (in brackets: detections; IoU from {groups[0].iou:g})", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    _write(figure, path)


def _cut_off(values: NDArray[np.floating], limit: float) -> str:
    """Return at which ends of a colour bar from -limit to limit values lie beyond it, in matplotlib's words."""
    below, above = bool((values < -limit).any()), bool((values > limit).any())
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[below, above]


def _write(figure: Figure, path: Path) -> None:
    """Write a figure, completely or not at all."""
    with writing(path) as temporary, plain_text(figure):
        FigureCanvasAgg(figure).print_figure(temporary, metadata={"Software": None})

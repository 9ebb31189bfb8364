"""Say what a named effect means and what to do about it, for a reader who has to act on the name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.gap.naming.named_effects import NamedEffect
from sensors.effects.base import Stage

_ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Advice:
    """What a named effect (sensor error) means and what to do about it, in whole sentences for the report.

    Attributes
    ----------
    means : what the effect says about the instrument or the measurement.
    act : what to do.
    """

    means: str
    act: str


_ABOUT_A_SURFACE_TERM = Advice(
    "The cloud has another shape than the reference. The term says where and by how much. Without cameras the cause cannot be "
    "found.",
    "Give the cameras (--cameras), and their effects are tried by name. A bowl or a dome over the whole wall is typical of a "
    "self-calibrated block of parallel views (lens distortion). A tilt or a step along the wall suggests a weak end of the "
    "block or a seam. Oblique views, control points or a calibration of the camera separate the two.",
)
_ABOUT_POINT_NOISE = Advice(
    "The points scatter more than the model says.",
    "Simulate and plan with the estimated value. The maps and profiles show where the points scatter most, such as steep parts, "
    "edges or smooth rock without texture.",
)


def advice_on(named: NamedEffect) -> Advice:
    """Return the sentences of the report on what a named effect (sensor error) means and what to do about it.

    The texts are those of the effect's class, or else the first paragraph of its docstring. Empirical terms, which are curves
    without a physical cause, have a general text.
    """
    if named.effect.stage == Stage.POINT:
        return _ABOUT_POINT_NOISE if named.adds_variance else _ABOUT_A_SURFACE_TERM
    if named.kind == "empirical":
        return Advice(
            "The cause is not in the catalogue. The term describes the pattern, not the cause. From one station, a reference "
            "that errs in strips or by a bend along the same direction looks the same.",
            "See below where it shows, and think of what the instrument does there. Then measure so that an instrument error "
            "would move and an error of the reference would not: from another station, at another time, in the second face. "
            "Until then, simulations with model_after.yaml contain the pattern.",
        )
    effect = named.effect
    first = " ".join((effect.__doc__ or "").strip().partition("\n\n")[0].split())
    return Advice(effect.means or first, effect.act or "Simulate with model_after.yaml, and ask the author of the effect.")


def page_of(name: str) -> str:
    """Return the address (file URI) of a documentation page on this machine, to link it in the report.

    Parameters
    ----------
    name : path of the page without ending, such as `reference/effects/tls.wobble`.

    Returns
    -------
    str : address of the page in the built site (`make docs`); else of its source; "" if neither exists.
    """
    pages = _ROOT / "site" / f"{name}.html", _ROOT / "docs" / f"{name}.md"
    return next((page.as_uri() for page in pages if page.is_file()), "")

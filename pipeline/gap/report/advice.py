"""What a named effect means, and what to do about it: a report's words for a reader who has to act on a name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.gap.naming.named_effects import NamedEffect
from sensors.effects.base import Stage

_ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Advice:
    """means: what it says of the instrument or the measurement; act: what to do. Whole sentences."""

    means: str
    act: str


_ABOUT_A_SURFACE_TERM = Advice(
    "The cloud has another shape than the reference. The term says where and by how much; without cameras nothing can be said of "
    "the cause.",
    "Give the cameras (--cameras): then their effects are tried by name. A bowl or a dome over the whole wall is what a block of "
    "parallel views that calibrates itself leaves behind (lens distortion); a tilt or a step along the wall is rather a "
    "weak end of the block or a seam. Oblique views, control points or a calibration of the camera tell.",
)
_ABOUT_POINT_NOISE = Advice(
    "The points scatter more than the model says.",
    "Simulate and plan with the value found. The maps and profiles show where they scatter most: steep parts, edges or smooth "
    "rock without texture.",
)


def advice_on(named: NamedEffect) -> Advice:
    """Of an effect what its class says; of one that says nothing its docstring; of an empirical term general words."""
    if named.effect.stage == Stage.POINT:
        return _ABOUT_POINT_NOISE if named.spreads else _ABOUT_A_SURFACE_TERM
    if named.kind == "empirical":
        return Advice(
            "Something that the catalogue does not hold: the term describes its pattern and says nothing of its cause. From one "
            "station a reference that is itself wrong in strips, or by a bend, along the same direction looks the same.",
            "Look at where it shows below, think of what the instrument does there, and measure so that it would move, as the "
            "reference's errors do not: another station, another time, the second face. Simulations with model_after.yaml have "
            "the pattern meanwhile.",
        )
    effect = named.effect
    first = " ".join((effect.__doc__ or "").strip().partition("\n\n")[0].split())
    return Advice(effect.means or first, effect.act or "Simulate with model_after.yaml, and ask whoever wrote the effect.")


def page_of(name: str) -> str:
    """Return the address of a page of the documentation as a file on this machine; "" where the documentation is not installed.

    name: its path without ending, such as `reference/effects/tls.wobble`. The built site (`make docs`) comes before the text.
    """
    pages = _ROOT / "site" / f"{name}.html", _ROOT / "docs" / f"{name}.md"
    return next((page.as_uri() for page in pages if page.is_file()), "")

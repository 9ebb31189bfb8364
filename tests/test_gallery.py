"""The gallery in docs/reference/effects is complete; `python docs/make_gallery.py` writes it."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
from effect_words import symbols
from make_gallery import parameter_table

from sensors.effects import FURTHER_EFFECTS, STEREO_EFFECTS, TLS_EFFECTS
from sensors.effects.base import Effect

EFFECTS = (*TLS_EFFECTS, *STEREO_EFFECTS, *FURTHER_EFFECTS)
FOLDER = Path(__file__).parents[1] / "docs" / "reference" / "effects"
NO_SYMBOLS = {"A", "K", "M", "m", "x", "y", "z"}
"""Letters that are units, axes or the article in the text of an equation."""


def test_every_effect_has_a_page_and_a_small_picture_and_nothing_else_does() -> None:
    names = {f"{effect.sensor}.{effect.model_fields['name'].default}" for effect in EFFECTS}
    assert {path.stem for path in FOLDER.glob("*.png")} == names
    assert {path.stem for path in FOLDER.glob("*.md")} == names | {"README"}
    assert max(path.stat().st_size for path in FOLDER.glob("*.png")) <= 60_000


def test_every_page_states_the_effects_present_parameters() -> None:
    for effect in EFFECTS:
        page = (FOLDER / f"{effect.sensor}.{effect.model_fields['name'].default}.md").read_text()
        assert parameter_table(effect) in page


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.tag())
def test_a_page_has_the_present_words_and_explains_the_symbols_of_its_equation_only(effect: type[Effect]) -> None:
    page = (FOLDER / f"{effect.sensor}.{effect.tag()}.md").read_text()
    equation = inspect.cleandoc(effect.__doc__ or "")
    assert equation in page
    assert effect.means in page
    assert effect.act in page
    assert symbols(effect) in page
    named = [each.split(": ")[0] for each in re.split(r"\n- |; (?=\w+: )", symbols(effect))[1:]]
    explained = {symbol.split("(")[0] for each in named for symbol in each.split(", ") if symbol not in ("px", "...)")}
    assert all(symbol.strip() in equation for symbol in explained)
    written = set(re.findall(r"(?<![\w'^/])(?:d[RZxz]|daz|dd|[A-Zb-hj-z])(?![\w'.])", equation)) - NO_SYMBOLS
    assert written <= {symbol.strip() for symbol in explained} | {"N"}

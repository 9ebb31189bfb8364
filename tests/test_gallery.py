"""The gallery in docs/reference/effects is complete; `python docs/make_gallery.py` writes it."""

from __future__ import annotations

from pathlib import Path

from make_gallery import parameter_table

from sensors.effects import FURTHER_EFFECTS, STEREO_EFFECTS, TLS_EFFECTS

EFFECTS = (*TLS_EFFECTS, *STEREO_EFFECTS, *FURTHER_EFFECTS)
FOLDER = Path(__file__).parents[1] / "docs" / "reference" / "effects"


def test_every_effect_has_a_page_and_a_small_picture_and_nothing_else_does() -> None:
    names = {f"{effect.sensor}.{effect.model_fields['name'].default}" for effect in EFFECTS}
    assert {path.stem for path in FOLDER.glob("*.png")} == names
    assert {path.stem for path in FOLDER.glob("*.md")} == names | {"README"}
    assert max(path.stat().st_size for path in FOLDER.glob("*.png")) <= 60_000


def test_every_page_states_the_effects_present_parameters() -> None:
    for effect in EFFECTS:
        page = (FOLDER / f"{effect.sensor}.{effect.model_fields['name'].default}.md").read_text()
        assert parameter_table(effect) in page

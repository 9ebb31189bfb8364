"""The pages in docs/reference/gap are complete; `python docs/make_gap_pages.py` writes them from the effects and the verdicts."""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.gap.naming.verdict import VERDICTS
from sensors.effects import STEREO_EFFECTS, TLS_EFFECTS

FOLDER = Path(__file__).parents[1] / "docs" / "reference" / "gap"
NAMES = {f"{effect.sensor}.{effect.model_fields['name'].default}" for effect in (*TLS_EFFECTS, *STEREO_EFFECTS)}


def test_every_effect_stands_once_in_the_table_from_symptom_to_cause_with_its_picture() -> None:
    rows = [line for line in (FOLDER / "symptoms.md").read_text().splitlines() if line.startswith("| ![")]
    named = [re.findall(r"\[([a-z]+\.[a-z_]+)\]\(\.\./effects/", row) for row in rows]
    assert sorted(name for names in named for name in names) == sorted(NAMES)
    assert all((FOLDER / "images" / f"{name}.png").stat().st_size < 30_000 for name in NAMES)


def test_every_verdict_has_a_page_that_says_what_the_report_says() -> None:
    for verdict, words in VERDICTS.items():
        page = (FOLDER / f"{verdict}.md").read_text()
        assert words in page
        assert f"\n{verdict}: " in page  # the example got this verdict


def test_no_picture_is_missing_and_none_is_left_over() -> None:
    shown = {name for page in FOLDER.glob("*.md") for name in re.findall(r"\(images/([^)]+)\)", page.read_text())}
    assert shown == {path.name for path in (FOLDER / "images").glob("*.png")}

"""Reports: the pictures show the given data, the page contains every number and needs no network."""

from __future__ import annotations

import base64
import dataclasses
import io
import re
from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.report.curve_figures import convergence_figure, histogram_figure
from pipeline.report.figures import (
    block_boxes,
    blocks_figure,
    difference_figure,
    hillshade_figure,
    plain_numbers,
)
from pipeline.report.page import litres, template
from pipeline.run.page import BlockRow, EpochReport, RegistrationSummary, RunReport, write_report
from scene.geometry.grid import Grid

TEMPLATES = Path(__file__).parents[2] / "pipeline"
GRID = Grid(x_min=0.0, y_max=20.0, gsd=0.1, width=300, height=200)
SIGMA_M = 0.008
HISTORY = [SimpleNamespace(rms_m=0.03 / step, inliers=900 + step, points=1000) for step in range(1, 6)]
INSIDE = {"count": 71579, "median_m": 0.2143, "standard_deviation_m": 0.1191, "rmse_m": 0.2508, "nmad_m": 0.1322}
OUTSIDE = {"count": 7732834, "median_m": -0.0006, "standard_deviation_m": 0.0094, "rmse_m": 0.0097, "nmad_m": 0.0082}
NO_DATA = {"count": 0, "median_m": None, "standard_deviation_m": None, "rmse_m": None, "nmad_m": None}


def synthetic() -> tuple[np.ndarray, np.ndarray]:
    """Differences with a niche of 60 sigma, a rise of 60 sigma beside it and a hole, and the niche's label."""
    difference = np.random.default_rng(5).normal(0, SIGMA_M, GRID.shape).astype(np.float32)
    block = np.zeros(GRID.shape, dtype=np.int32)
    difference[40:80, 60:120], block[40:80, 60:120] = 60 * SIGMA_M, 1
    difference[40:80, 180:240] = -60 * SIGMA_M
    difference[120:160, 60:120] = np.nan
    return difference, block


def pixel(png: bytes, x: float, y: float) -> np.ndarray:
    """Return the RGB (3,) in [0, 1] of a map at wall coordinates; the axes' frame is found as the outermost dark lines."""
    image = matplotlib.image.imread(io.BytesIO(png))[:, :, :3]
    dark = image.max(axis=2) < 0.2
    rows = np.flatnonzero(dark.mean(axis=1) > 0.6)
    columns = np.flatnonzero(dark[rows[0] : rows[-1]].mean(axis=0) > 0.95)[:2000]
    left, right = columns[0], columns[columns < columns[0] + 1.6 * (rows[-1] - rows[0])][-1]
    column = left + (right - left) * (x - GRID.x_min) / (GRID.width * GRID.gsd)
    row = rows[0] + (rows[-1] - rows[0]) * (GRID.y_max - y) / (GRID.height * GRID.gsd)
    return image[int(row), int(column)]


def test_difference_map_shows_missing_rock_red_at_its_place() -> None:
    difference, block = synthetic()
    png = difference_figure(difference, GRID, block, SIGMA_M)
    red, blue, grey = pixel(png, 9, 14), pixel(png, 21, 14), pixel(png, 9, 6)
    assert red[0] > red[2] + 0.2
    assert blue[2] > blue[0] + 0.2
    assert np.ptp(grey) < 0.02
    assert 0.6 < grey[0] < 0.8
    with pytest.raises(ValueError, match="positive"):
        difference_figure(difference, GRID, block, 0.0)


def test_colours_end_at_six_sigma() -> None:
    """Values beyond the scale have its last colour, values at half of the scale another one."""
    block = np.zeros(GRID.shape, dtype=np.int32)
    colours = {
        factor: pixel(difference_figure(np.full(GRID.shape, factor * SIGMA_M), GRID, block, SIGMA_M), 15, 10)
        for factor in (0, 3, 6, 60)
    }
    np.testing.assert_array_equal(colours[6], colours[60])
    assert np.abs(colours[3] - colours[6]).max() > 0.1
    assert colours[0].min() > 0.93


def test_hillshade_is_lit_from_the_upper_left() -> None:
    """A slope that faces up and left is the brightest, its opposite the darkest, the level wall in between."""
    y, x = np.mgrid[GRID.y_max : 0 : -GRID.gsd, 0 : GRID.width * GRID.gsd : GRID.gsd][:, : GRID.height, : GRID.width]
    shades = [pixel(hillshade_figure(slope * (y - x), GRID), 15, 10).mean() for slope in (0.5, 0.0, -0.5)]
    assert shades[0] < shades[1] < shades[2]  # rising towards the upper left, it faces the lower right
    assert np.ptp(pixel(hillshade_figure(np.full(GRID.shape, np.nan), GRID), 15, 10)) > 0.05  # no data is no grey


@pytest.mark.parametrize("size", [(1, 1), (1, 5000), (4100, 3), (2300, 2100)])
def test_rasters_of_any_size(size: tuple[int, int]) -> None:
    grid = Grid(0, 10, 0.02, width=size[1], height=size[0])
    heights = np.zeros(size, dtype=np.float32)
    assert hillshade_figure(heights, grid).startswith(b"\x89PNG")
    assert difference_figure(heights, grid, np.ones(size, dtype=np.int32), 0.01).startswith(b"\x89PNG")


def figures() -> list[Callable[[], bytes]]:
    difference, block = synthetic()
    return [
        lambda: hillshade_figure(difference, GRID, "Reference"),
        lambda: difference_figure(difference, GRID, block, SIGMA_M),
        lambda: histogram_figure(difference[block == 0], difference[block == 1]),
        lambda: histogram_figure(np.empty(0), np.full(3, np.nan)),
        lambda: convergence_figure(HISTORY),
        lambda: convergence_figure([]),
    ]


@pytest.mark.parametrize("index", range(6))
def test_figures_are_png_of_equal_bytes_without_software_or_date(index: int) -> None:
    draw = figures()[index]
    png = draw()
    assert png.startswith(b"\x89PNG")
    assert png == draw()
    assert b"tEXt" not in png
    assert b"tIME" not in png
    image = matplotlib.image.imread(io.BytesIO(png))
    assert 500 < image.shape[1] <= 2000


def run_report() -> RunReport:
    rows = [
        BlockRow(1, "cube", (1.36, 1.28, 0.36), 0.453, 0.434, (48.92, 28.0, 0.3), (512049.04, 6123456.5, 329.4), True),
        BlockRow(2, "sphere", (0.52, 0.41, 0.33), 0.0769, None, (8.92, 23.3, -0.31), (512009.01, 6123457.5, 334.1), False),
    ]
    registration = RegistrationSummary(
        rms_m=0.0123, inliers=90123, points=95456, iterations=14, reason="the step is below the threshold"
    )
    first = EpochReport(1, 4812345, INSIDE, OUTSIDE, 0.0081, rows, b"hillshade1", b"map1", b"histogram1", b"icp1", registration)
    second = EpochReport(2, 17, NO_DATA, NO_DATA, 0.001, [], b"hillshade2", b"map2", b"histogram2")
    config = {"seed": 7, "wall": {"style": "glendale", "name": "<b>& Söhne</b>"}, "difference": {"gsd_m": 0.025}}
    return RunReport("Wall <A> & B", "stereo", 7, b"reference", [first, second], config, {"Pixel": "25 mm"})


class Page(HTMLParser):
    """Parses a page: its text, its elements in order, and whether they are nested properly."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture
def html(tmp_path: Path) -> str:
    write_report(tmp_path / "report.html", run_report())
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def test_page_holds_every_number(html: str) -> None:
    text = unescape(re.sub(r"data:image[^\"]*", "", html)).replace("\N{MINUS SIGN}", "-")
    expected = ["4,812,345", "71,579", "7,732,834", "214.3 mm", "119.1 mm", "250.8 mm", "132.2 mm", "-0.6 mm", "9.4 mm", "9.7 mm"]
    expected += ["8.2 mm", "8.1 mm", "12.3 mm", "90,123", "95,456", "14 iterations", "the step is below the threshold", "25 mm"]
    expected += ["1.36, 1.28, 0.36", "453", "434", "-4.2 %", "48.92, 28.00, 0.30", "512049.04, 6123456.50, 329.40"]
    expected += ["0.52, 0.41, 0.33", "76.9", "8.92, 23.30, -0.31", "512009.01, 6123457.50, 334.10", "sphere"]
    expected += ["gsd_m: 0.025", "style: glendale", "<b>& Söhne</b>"]
    assert [number for number in expected if number not in text] == []
    said = "Epoch 1: 2 blocks carved of 530 l together, of which the map shows 434 l, 1 annotated; outside the blocks"
    assert f"{said} the difference map has NMAD 8.2 mm and median -0.6 mm." in text
    assert "Epoch 2: 0 blocks carved, 0 annotated; the difference map has no data outside the blocks." in text
    assert "None" not in text
    assert "nan" not in text


def test_reports_give_the_answer_the_picture_the_evidence_and_then_the_settings(html: str) -> None:
    places = [
        html.index(part) for part in ('class="lead"', "<figure>", "How good the maps are", "Settings", "The resolved config")
    ]
    assert places == sorted(places)
    for name in ("calibration", "comparison", "planning"):
        page = (TEMPLATES / name / "report.html.jinja").read_text()
        places = [page.index(part) for part in ('class="lead"', "<figure>", 'class="wide"', "Settings")]
        if name != "calibration":  # its picture is a macro, called before the tables
            assert places == sorted(places), name


def test_page_is_whole_escaped_and_needs_no_network(html: str) -> None:
    page = Page(html)
    assert page.open == []
    assert "<b>" not in html
    assert "Wall &lt;A&gt; &amp; B" in html
    assert not re.search(r"https?://|src=\"//|@import|<script|<link|url\(", html)
    images = page.all("img")
    assert all(image["alt"] for image in images)
    found = [base64.b64decode((image["src"] or "").removeprefix("data:image/png;base64,")) for image in images]
    assert found == [b"map1", b"reference", b"hillshade1", b"histogram1", b"icp1", b"map2", b"hillshade2", b"histogram2"]
    assert len(page.all("figcaption")) == len(images)
    assert "@media print" in html


def test_page_is_the_same_twice_and_says_when_it_is_not_complete(tmp_path: Path, html: str) -> None:
    write_report(tmp_path / "again.html", run_report())
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == html
    assert "interrupted" not in html
    write_report(tmp_path / "part.html", dataclasses.replace(run_report(), complete=False, epochs=[], key_figures={}))
    assert "The run was interrupted" in (tmp_path / "part.html").read_text(encoding="utf-8")


def test_many_blocks_come_folded(tmp_path: Path) -> None:
    report = run_report()
    for count, unfolded in ((60, True), (1500, False)):
        blocks = [dataclasses.replace(report.epochs[0].blocks[0], label=label) for label in range(1, count + 1)]
        epoch = dataclasses.replace(report.epochs[0], blocks=blocks)
        write_report(tmp_path / "report.html", dataclasses.replace(report, epochs=[epoch]))
        page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
        assert ("open" in page.all("details")[0]) == unfolded
        assert len(page.all("tr")) > count


def test_what_comes_from_a_file_stays_text(tmp_path: Path) -> None:
    """A wall's name, a scanner's name and a path in the config are escaped; no template outputs an unescaped value."""
    evil = "</title></pre><script>alert(1)</script>"
    report = RunReport(evil, "tls", 1, b"", [], {"wall": {"mesh": evil}}, {"Sensor": evil, evil: "x"})
    write_report(tmp_path / "report.html", report)
    page = (tmp_path / "report.html").read_text()
    assert "<script>" not in page
    assert page.count("&lt;script&gt;alert(1)") == 5
    for path in TEMPLATES.rglob("*.jinja"):
        assert template(path.relative_to(TEMPLATES).as_posix()).environment.autoescape is True
        past = re.findall(r"\{\{([^}]*)\| *safe", path.read_text())
        assert all(re.fullmatch(r"\s*'[^']*'\s*", value) for value in past), path.name


def test_blocks_are_shown_by_themselves_in_the_order_given() -> None:
    difference, block = synthetic()
    block[130:140, 200:230] = 7
    assert block_boxes(block) == {1: (60, 120, 80, 40), 7: (200, 230, 140, 130)}
    both = blocks_figure(difference, GRID, block, SIGMA_M, {7: "1 l", 1: "2 l", 9: "not on the map"})
    assert both is not None
    assert both.startswith(b"\x89PNG")
    assert both != blocks_figure(difference, GRID, block, SIGMA_M, {1: "2 l", 7: "1 l"})
    assert blocks_figure(difference, GRID, np.zeros_like(block), SIGMA_M, {1: "2 l"}) is None
    assert block_boxes(np.zeros_like(block)) == {}


@pytest.mark.parametrize(
    ("limits", "shown"), [((0.01, 0.6), ["0.01", "0.02", "0.05", "0.1", "0.2", "0.5"]), ((2e-4, 0.2), ["0.001", "0.01", "0.1"])]
)
def test_numbers_of_a_logarithmic_axis_have_room(limits: tuple[float, float], shown: list[str]) -> None:
    axes = Figure().add_subplot()
    axes.set_xscale("log")
    plain_numbers(axes.xaxis)
    axes.set_xlim(limits)
    labels = [
        text for at, text in zip(axes.get_xticks(), axes.xaxis.get_ticklabels(), strict=True) if limits[0] <= at <= limits[1]
    ]
    assert [text.get_text() for text in labels if text.get_text()] == shown


def test_volumes_are_read_in_litres() -> None:
    shown = [litres(value) for value in (0.000591, 0.0642, 1.2345, 123.0, -0.0123, 0.0, None)]
    assert shown == ["0.591", "64.2", "1,234", "123,000", "\N{MINUS SIGN}12.3", "0.00", "\N{EN DASH}"]


def test_the_table_ends_with_the_volume_of_all_blocks() -> None:
    epoch = run_report().epochs[0]
    assert epoch.total == pytest.approx((0.5299, 0.434))
    assert "2 blocks carved of 530 l together, of which the map shows 434 l" in epoch.summary()

"""Text files of points as users have them: encodings, names with units, separators, decimal commas, counts, and their errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.formats.points.points import read_placed_scans, read_points
from pipeline.formats.units import US_FOOT_M
from pipeline.measurement.scans import read_scans
from scene.common.errors import InputError

POINTS = np.array([[345215.25, 6389450.5, 120.125], [345216.5, 6389451.75, 121.0], [345217.0, 6389452.0, 122.5]])


def written(folder: Path, text: str, encoding: str = "utf-8", name: str = "a.txt") -> Path:
    (folder / name).write_bytes(text.encode(encoding))
    return folder / name


def rows(separator: str = " ", decimal: str = ".", order: str = "xyz", tail: str = "") -> str:
    """Return POINTS as text, with their axes in the given order and further values after them."""
    lines = (separator.join(f"{point['xyz'.index(axis)]:.4f}" for axis in order) + tail for point in POINTS)
    return "\n".join(lines).replace(".", decimal) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "latin-1", "cp1252"])
@pytest.mark.parametrize("header", ["", "Northing,Easting,Height\n", "# Höhe über Meer\nNorthing,Easting,Höhe\n"])
def test_the_encoding_takes_no_point_and_no_name(tmp_path: Path, encoding: str, header: str) -> None:
    """A byte-order mark belongs to no name and no number; text before the points may be in any common encoding."""
    path = written(tmp_path, header + rows(",", order="yxz" if header else "xyz"), encoding, "a.csv")
    np.testing.assert_array_equal(read_points(path).points, POINTS)


def test_a_comment_in_another_encoding_between_the_rows_is_passed_over(tmp_path: Path) -> None:
    text = rows() + "# Profil über den Fels\n" + rows() + "\n// Ende\n"
    for encoding in ("utf-8-sig", "latin-1", "utf-16"):
        found = read_points(written(tmp_path, text, encoding)).points
        np.testing.assert_array_equal(found, np.concatenate([POINTS, POINTS]))


@pytest.mark.parametrize(
    "header",
    [
        "Northing [m]\tEasting [m]\tHeight [m]\n",
        "Northing (m)\tEasting (m)\tHeight (m)\n",
        '"Northing"\t"Easting"\t"Height"\n',
        "Y Coordinate\tX Coordinate\tZ Coordinate\n",
        "N_m\tE_m\tH_m\n",
        "Hochwert\tRechtswert\tHöhe\n",
        "// Northing Easting Height\n",
        "\n# exported\n#Northing;Easting;Height\n3\n",
    ],
)
def test_names_are_split_at_the_separator(tmp_path: Path, header: str) -> None:
    np.testing.assert_array_equal(read_points(written(tmp_path, header + rows("\t", order="yxz"))).points, POINTS)


def test_names_with_spaces_keep_their_columns(tmp_path: Path) -> None:
    """CloudCompare's header, and names with units separated by white space."""
    text = "//X;Y;Z;Roughness (0.01);Intensity\n3\n" + rows(";", tail=";0.002;7")
    found = read_points(written(tmp_path, text))
    np.testing.assert_array_equal(found.intensity, [7, 7, 7])
    np.testing.assert_array_equal(found.extra["roughness (0.01)"], [0.002] * 3)
    found = read_points(written(tmp_path, "X [m] Y [m] Z [m] Intensity (dB) Range (mm) Time [ms]\n" + rows(tail=" -20 81500 5")))
    np.testing.assert_array_equal(found.points, POINTS)
    np.testing.assert_allclose(found.intensity, [0.01] * 3)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.extra["range_m"], [81.5] * 3)
    np.testing.assert_allclose(found.gps_time, [0.005] * 3)  # type: ignore[arg-type]
    assert "intensity was converted from db" in found.notes


@pytest.mark.parametrize(
    ("units", "factors"),
    [
        (("ft", "ft", "ft"), (0.3048,) * 3),
        (("US survey foot",) * 3, (US_FOOT_M,) * 3),
        (("ftUS", "ftUS", "m"), (US_FOOT_M, US_FOOT_M, 1.0)),
        (("mm", "mm", "mm"), (0.001,) * 3),
        (("ft", "ft", ""), (0.3048,) * 3),
    ],
)
def test_a_unit_in_the_names_is_applied(tmp_path: Path, units: tuple[str, str, str], factors: tuple[float, ...]) -> None:
    names = ";".join(f"{axis} [{unit}]" if unit else axis for axis, unit in zip("XYZ", units, strict=True))
    path = written(tmp_path, names + "\n" + rows(";"))
    found = read_points(path)
    np.testing.assert_allclose(found.points, POINTS * factors, rtol=1e-15)
    assert "converted from" in " ".join(found.notes)
    by_columns = read_placed_scans(path, columns=["y", "x", "z"])[0].cloud
    np.testing.assert_allclose(by_columns.points, (POINTS * factors)[:, [1, 0, 2]], rtol=1e-15)
    with pytest.raises(InputError, match=r"states its unit, .* in the names of its columns, but --unit says cm"):
        read_placed_scans(path, unit="cm")


@pytest.mark.parametrize("units", ["[ft];[ft];[ft];[dB]", "ft;ft;ft;-", "(ft);(ft);(ft);"])
def test_a_line_of_units_under_the_names_is_applied(tmp_path: Path, units: str) -> None:
    found = read_points(written(tmp_path, f"Northing;Easting;Height;Intensity\n{units}\n" + rows(";", order="yxz", tail=";-10")))
    np.testing.assert_allclose(found.points, POINTS * 0.3048, rtol=1e-15)
    assert found.intensity is not None
    np.testing.assert_allclose(found.intensity, 0.1 if "dB" in units else -10)


def test_a_grid_of_heights_is_no_list_of_points(tmp_path: Path) -> None:
    text = "ncols 4\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\nNODATA_value -9999\n1 2 3 4\n5 6 7 8\n"
    with pytest.raises(InputError, match=r"grid of heights \(ESRI ASCII\).*gdal_translate"):
        read_points(written(tmp_path, text, name="a.asc"))


@pytest.mark.parametrize(
    ("header", "problem"),
    [
        ("Latitude;Longitude;Height\n", "coordinates in degrees"),
        ("X [deg];Y [deg];Z [m]\n", "coordinates in degrees"),
        ("X [cubit];Y [cubit];Z [cubit]\n", "the unknown unit 'cubit'"),
        ("X;Y;Z;Intensity\n", "names 4 columns .* but the rows have 3"),
        ("Vorn;Seite;Oben\n", "which do not include x, y and z"),
        ("azimuth;elevation;range\n", "which do not include x, y and z"),
    ],
)
def test_names_that_are_not_understood_are_errors(tmp_path: Path, header: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        read_points(written(tmp_path, header + rows(";")))
    assert "line 1" in caught.value.where
    assert caught.value.remedy


@pytest.mark.parametrize("separator", [";", "\t", " ", "|", "; "])
def test_decimal_commas_are_read(tmp_path: Path, separator: str) -> None:
    found = read_points(written(tmp_path, rows(separator, ",")))
    np.testing.assert_array_equal(found.points, POINTS)
    assert "commas in numbers are read as decimal marks" in found.notes


def test_commas_between_values_are_no_decimal_marks(tmp_path: Path) -> None:
    for separator in (",", ", ", " ,"):
        np.testing.assert_array_equal(read_points(written(tmp_path, rows(separator))).points, POINTS)


@pytest.mark.parametrize(
    "line",
    [
        "345,215.25;6,389,450.5;120.125",
        "345.215,25;6.389.450,5;120,125",
        "345'215.25;6'389'450.5;120.125",
        "345 215.25;6 389 450.5;120.125",
        "345\u00a0215,25;6\u00a0389\u00a0450,5;120,125",
        "345,215;6,389,450;120",
    ],
)
@pytest.mark.parametrize("place", ["first", "later"])
def test_thousands_separators_are_refused_by_name(tmp_path: Path, line: str, place: str) -> None:
    decimal = "," if ",1" in line and "." not in line.split(";")[2] and line.endswith(",125") else "."
    before = "" if place == "first" else rows(";", decimal) * 200
    with pytest.raises(
        InputError, match=r"line \d+.*digits of .* are grouped by a thousands separator.*without thousands separators"
    ):
        read_points(written(tmp_path, before + line + "\n" + rows(";", decimal)))


def test_whole_numbers_beside_commas_before_three_digits_are_grouped(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="thousands separator"):
        read_points(written(tmp_path, "1,234;5,678;987\n1,300;999;1,001\n" * 20))
    three_decimals = "1,234;5,678;0,987\n1,300;0,999;1,001\n"
    np.testing.assert_array_equal(read_points(written(tmp_path, three_decimals)).points[0], [1.234, 5.678, 0.987])


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        (rows() + "4 five 6\n" + rows(), 4, "'five' is not a number"),
        (rows() + "4 5\n" + rows(), 4, r"the number of values in this line is 2 \('4 5'\).*allowed: 3"),
        (rows() + "345217.0 63894", 4, "the file was cut off"),
        ("# a\n\n" + rows(";") + "4,5;5;6\n", 6, "decimal comma, but other numbers"),
        (rows(";", ",") + "4.5;5,1;6,1\n", 4, "decimal point, but other numbers"),
    ],
)
def test_a_line_that_is_no_row_is_named(tmp_path: Path, text: str, line: int, problem: str) -> None:
    """The message has the line's number, its text and what is allowed; nothing of NumPy's message."""
    with pytest.raises(InputError, match=rf"a\.txt, line {line}\b.*{problem}") as caught:
        read_points(written(tmp_path, text))
    assert "usecols" not in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize(("stated", "suffix"), [(2, ".pts"), (4, ".pts"), (9, ".xyz")])
def test_a_count_that_the_rows_do_not_agree_with_is_an_error(tmp_path: Path, stated: int, suffix: str) -> None:
    with pytest.raises(InputError, match=f"states {stated} points, but 3 follow"):
        read_points(written(tmp_path, f"{stated}\n" + rows(), name=f"a{suffix}"))
    np.testing.assert_array_equal(read_points(written(tmp_path, "3\n" + rows(), name=f"a{suffix}")).points, POINTS)


def test_a_pts_file_of_several_scans_has_a_count_before_each(tmp_path: Path) -> None:
    both = read_points(written(tmp_path, "3\n" + rows() + "3\n" + rows(), name="a.pts")).points
    np.testing.assert_array_equal(both, np.concatenate([POINTS, POINTS]))
    with pytest.raises(InputError, match=r"line 5.*states 5 points, but 3 follow"):
        read_points(written(tmp_path, "3\n" + rows() + "5\n" + rows(), name="a.pts"))


def test_missing_values_are_left_out_with_a_word(tmp_path: Path) -> None:
    """They are written as 1.#QNAN, null or nothing between separators; a measurement leaves such points out and says so."""
    text = rows(";", tail=";1;") + "1.#QNAN;null;;1;\n" + rows(";", tail=";1;")
    found = read_points(written(tmp_path, text))
    assert np.isnan(found.points[3]).all()
    assert "3 values are empty or not numbers" in found.notes
    rng = np.random.default_rng(1)
    many = "".join(f"{x} {y} {z}\n" for x, y, z in rng.uniform(0, 9, (200, 3)))
    (scan,) = read_scans(written(tmp_path, many + "nan nan nan\n" * 7))
    assert len(scan.cloud.points) == 200
    assert "7 points with coordinates that are not numbers are left out" in scan.words


def test_a_binary_file_with_a_suffix_of_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(InputError, match=r"null bytes, like binary files.*export the points as text"):
        read_points(tmp_path / "a.xyz")


def test_a_line_that_is_passed_over_is_said(tmp_path: Path) -> None:
    found = read_points(written(tmp_path, "Scan of the north face, 3 March\n" + rows()))
    np.testing.assert_array_equal(found.points, POINTS)
    assert any("line 1 is ignored: 'Scan of the north face" in note for note in found.notes)


def test_sentences_before_the_points_are_no_names(tmp_path: Path) -> None:
    for line in ("# north face, morning", "# lat 47.1 lon 8.2 of the station", "// x y z are in the local grid of the mine"):
        np.testing.assert_array_equal(read_points(written(tmp_path, line + "\n" + rows())).points, POINTS)


def test_a_file_that_ends_within_a_number_is_cut_off(tmp_path: Path) -> None:
    whole = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in POINTS[2] + 0.25 * np.arange(90)[::-1, None])
    for end, whole_file in ((-1, True), (-2, False), (-4, False)):
        path = written(tmp_path, whole[:end])
        if whole_file:
            assert len(read_points(path).points) == 90
            continue
        with pytest.raises(InputError, match=r"ends within a number: '122\.5.*4 decimals.*cut off"):
            read_points(path)


def test_a_column_of_words_is_left_out_by_name(tmp_path: Path) -> None:
    found = read_points(written(tmp_path, "X,Y,Z,Class,Intensity\n" + rows(",", tail=",hard rock,7"), name="a.csv"))
    np.testing.assert_array_equal(found.points, POINTS)
    np.testing.assert_array_equal(found.intensity, [7, 7, 7])
    assert found.notes == ("column 4 (class) contains words and is left out",)
    labels = "".join(f"P{number},{row}\n" for number, row in enumerate(rows(",").split()))
    found = read_points(written(tmp_path, "# Targets, 1, 2, 3\nlabel,X,Y,Z\n" + labels, name="a.csv"))
    np.testing.assert_array_equal(found.points, POINTS)
    assert found.notes == ("column 1 (label) contains words and is left out",)
    np.testing.assert_array_equal(read_points(written(tmp_path, labels, name="a.csv")).points, POINTS)
    with pytest.raises(InputError, match="column 1, called x, contains words"):
        read_points(written(tmp_path, "X,Y,Z,W\n" + labels, name="a.csv"))
    with pytest.raises(InputError, match=r"line 3, column 4: 'rock' is not a number"):
        read_points(written(tmp_path, "X,Y,Z,Class\n" + rows(",", tail=",7").replace(",7", ",rock", 2).replace(",rock", ",7", 1)))


def test_a_name_that_is_a_part_of_xyz_is_a_channel(tmp_path: Path) -> None:
    found = read_points(written(tmp_path, "X,Y,Z,xy,yz [mm]\n" + rows(",", tail=",5,7"), name="a.csv"))
    assert list(found.extra) == ["xy", "yz_m"]
    np.testing.assert_allclose(found.extra["yz_m"], 0.007)


def test_a_coordinate_that_is_missing_everywhere_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="column 2, read as y, is empty in all 3 rows"):
        read_points(written(tmp_path, rows(",").replace(",6389", ",,6389")))


@pytest.mark.parametrize(("start", "problem"), [("ply\n", "is a PLY file"), ("# .PCD v.7 - Point Cloud\n", "is a PCD file")])
def test_files_of_other_formats_are_told_by_their_first_line(tmp_path: Path, start: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        read_points(written(tmp_path, start + rows()))


@pytest.mark.parametrize("row", ['"{0}","{1}","{2}"', "{0} {1} {2} # good", "{0:.9e} {1:.9e} {2:.9e}", "{0:.4f}D+00 {1} {2}"])
def test_numbers_as_other_programs_write_them(tmp_path: Path, row: str) -> None:
    """In quotation marks, with a comment after them, with exponents as in C and Fortran."""
    text = "\n".join(row.format(*point) for point in POINTS)
    np.testing.assert_allclose(read_points(written(tmp_path, text, name="a.csv")).points, POINTS, rtol=1e-9)
    quoted = "\n".join(",".join(f'"{value:.4f}"'.replace(".", ",") for value in point) for point in POINTS)
    np.testing.assert_allclose(read_points(written(tmp_path, quoted, name="b.csv")).points, POINTS, rtol=1e-9)

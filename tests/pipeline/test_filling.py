"""A folder of results appears only when it is complete."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.formats.files.atomic import check_place, empty_folder, filling, write_bytes, writing
from scene.common.errors import InputError


@pytest.mark.parametrize("there", [False, True])
def test_a_folder_is_filled_whole_or_not_at_all(tmp_path: Path, there: bool) -> None:
    out = tmp_path / "made" / "out"
    if there:
        out.mkdir(parents=True)

    def break_down() -> None:
        with filling(out) as folder:
            write_bytes(folder / "inner" / "first", b"1")
            assert not (out / "inner").exists()
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        break_down()
    assert out.exists() == there
    assert out.parent.exists() == there
    assert not list(out.glob("*"))
    with filling(out) as folder:
        write_bytes(folder / "inner" / "first", b"1")
        write_bytes(folder / "second", b"2")
    assert sorted(path.name for path in out.rglob("*")) == ["first", "inner", "second"]
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    with pytest.raises(InputError, match="not an empty folder"), filling(out):
        pass


def test_folders_made_for_a_file_go_with_it(tmp_path: Path) -> None:
    def break_down() -> None:
        with writing(tmp_path / "made" / "inner" / "file") as temporary:
            temporary.write_bytes(b"1")
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        break_down()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("file", "File exists"),
        ("file/out", "Not a directory"),
        ("loop", "File exists"),
        ("a" * 300, "name too long"),
        ("a\0", "null"),
    ],
)
def test_a_place_for_results_is_tried_before_anything_is_computed(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "loop").symlink_to("loop")
    for check in (check_place, empty_folder):
        with pytest.raises(InputError, match=reason):
            check(tmp_path / name)
    check_place(tmp_path / "new" / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "loop"]

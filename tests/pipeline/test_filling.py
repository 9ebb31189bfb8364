"""A folder of results appears when all of it is there."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.formats.atomic import filling, write_bytes
from scene.errors import InputError


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
    assert not list(out.glob("*"))
    with filling(out) as folder:
        write_bytes(folder / "inner" / "first", b"1")
        write_bytes(folder / "second", b"2")
    assert sorted(path.name for path in out.rglob("*")) == ["first", "inner", "second"]
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    with pytest.raises(InputError, match="not an empty folder"), filling(out):
        pass

"""The rules between folders, checked in the source: who imports whom, how long a file may be, what `--help` may load."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONGEST_FILE = 500
OF_SCENE_FOR_SENSORS = ("common", "geometry", "ray_casting", "appearance")
"""The folders of `scene` that a sensor may import: what it looks at, not how walls and blocks are made."""
HEAVY = ("numpy", "scipy", "mitsuba", "drjit", "pydantic", "matplotlib", "open3d", "cv2", "rich")

Imports = set[tuple[str, ...]]


@functools.cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """Return all nodes of the syntax tree of `source`; each file is read by several rules and parsed once."""
    return tuple(ast.walk(ast.parse(source)))


@pytest.fixture(autouse=True, scope="module")
def _forget_syntax_trees() -> Iterator[None]:
    yield
    nodes_of.cache_clear()


@functools.cache
def imports_of(source: str) -> frozenset[tuple[str, ...]]:
    """Return every absolute module path imported anywhere in `source`; `from a import b` counts as a.b."""
    found: Imports = set()
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layer"
            found |= {(*str(node.module).split("."), alias.name) for alias in node.names}
    return frozenset(found)


def violations(folder: str, imports: Imports) -> Imports:
    """Return the imports that a file of `folder` may not have."""
    forbidden = {"scene": {"sensors", "pipeline"}, "sensors": {"pipeline"}}.get(folder, set())
    wrong = {path for path in imports if path[0] in forbidden}
    if folder == "sensors":
        wrong |= {path for path in imports if path[0] == "scene" and path[1] not in OF_SCENE_FOR_SENSORS}
    return wrong


def sources(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("folder", ["scene", "sensors", "pipeline"])
def test_layers_import_downwards_only(folder: str) -> None:
    files = sources(folder)
    assert files
    wrong = {str(file.relative_to(ROOT)): violations(folder, imports_of(file.read_text())) for file in files}
    assert {file: found for file, found in wrong.items() if found} == {}


@pytest.mark.parametrize(
    ("folder", "line"),
    [
        ("scene", "from sensors.laser.tls import Scanner"),
        ("scene", "import pipeline.run.simulation"),
        ("scene", "def late():\n    from pipeline import run"),
        ("sensors", "from pipeline.run.simulation import simulate"),
        ("sensors", "from scene.blocks.carve import carve"),
        ("sensors", "from scene import blocks"),
    ],
)
def test_the_rule_sees_a_violation(folder: str, line: str) -> None:
    assert violations(folder, imports_of(line))


@pytest.mark.parametrize("folder", ["scene", "sensors", "pipeline"])
def test_mitsuba_comes_through_the_backend_only(folder: str) -> None:
    allowed = {ROOT / "scene/common/backend.py", ROOT / "pipeline/cli/doctor.py"}  # doctor looks where there may be no backend
    direct = [file for file in sources(folder) if {path[0] for path in imports_of(file.read_text())} & {"mitsuba", "drjit"}]
    assert set(direct) <= allowed


@pytest.mark.parametrize("folder", ["scene", "sensors", "pipeline"])
def test_what_cannot_be_is_said_by_types_and_not_by_asserts(folder: str) -> None:
    """`python -O` removes asserts; types that exclude the case need none."""
    trees = {str(file.relative_to(ROOT)): nodes_of(file.read_text()) for file in sources(folder)}
    assert [name for name, nodes in trees.items() if any(isinstance(node, ast.Assert) for node in nodes)] == []


def test_files_stay_short() -> None:
    lengths = {
        str(file.relative_to(ROOT)): len(file.read_text().splitlines())
        for folder in ("scene", "sensors", "pipeline", "tests", "benchmarks", "docs")
        for file in sources(folder)
    }
    assert {file: lines for file, lines in lengths.items() if lines > LONGEST_FILE} == {}


@pytest.mark.parametrize("words", [["--help"], ["simulate", "--help"], ["init", "--help"], ["doctor", "--help"]])
def test_help_loads_nothing_heavy(words: list[str]) -> None:
    program = f"import sys; from pipeline.cli.main import main; main({words}); print(*sys.modules, file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "example:" in result.stdout
    assert set(HEAVY) & set(result.stderr.split()) == set()


def test_reading_a_config_loads_none_of_the_slow_libraries() -> None:
    """Each step imports what only it needs; scipy and trimesh together would take longer to load than everything else."""
    program = "import sys, pipeline.config.simulation, pipeline.run.site; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    slow = {"scipy", "trimesh", "open3d", "matplotlib", "laspy", "pycocotools", "tensorflow"}
    assert slow & set(result.stdout.split()) == set()


def folder_of(module: tuple[str, ...]) -> str:
    """Return the folder of a module: `pipeline.gap.mean` for pipeline.gap.mean.selection."""
    return ".".join(module[:-1])


def room_edges(imports: dict[tuple[str, ...], Imports]) -> dict[str, set[str]]:
    """Return which sub-folders each sub-folder imports from, in all its modules, late imports included."""
    edges: dict[str, set[str]] = {folder_of(module): set() for module in imports}
    for module, found in imports.items():
        for path in found:
            known = next((path[:size] for size in (len(path), len(path) - 1) if path[:size] in imports), None)
            if known is not None and folder_of(known) != folder_of(module):
                edges[folder_of(module)].add(folder_of(known))
    return edges


def modules() -> dict[tuple[str, ...], Imports]:
    return {
        file.relative_to(ROOT).with_suffix("").parts: imports_of(file.read_text())
        for folder in ("scene", "sensors", "pipeline")
        for file in sources(folder)
        if file.name != "__init__.py"
    }


def test_no_rooms_need_each_other() -> None:
    """A cycle raises CycleError, which names the sub-folders."""
    order = list(TopologicalSorter(room_edges(modules())).static_order())
    assert order.index("scene.common") < order.index("sensors.laser") < order.index("pipeline.run") < order.index("pipeline.cli")


def test_the_rule_sees_rooms_that_need_each_other() -> None:
    imports: dict[tuple[str, ...], Imports] = {
        ("pipeline", "a", "one"): {("pipeline", "b", "two", "Two")},
        ("pipeline", "b", "two"): set(),
        ("pipeline", "b", "three"): {("pipeline", "a", "one", "One")},
    }
    with pytest.raises(CycleError):
        list(TopologicalSorter(room_edges(imports)).static_order())


def test_every_module_lies_in_a_folder() -> None:
    beside = {
        file.relative_to(ROOT).as_posix() for folder in ("scene", "sensors", "pipeline") for file in (ROOT / folder).glob("*.py")
    }
    assert beside == {"scene/__init__.py", "sensors/__init__.py", "sensors/subset.py", "pipeline/__init__.py"}


def test_every_folder_says_what_it_holds() -> None:
    """A folder's docstring says what is in it, what is not, and where to start."""
    described = {
        file.relative_to(ROOT).as_posix(): ast.get_docstring(ast.parse(file.read_text())) or ""
        for folder in ("scene", "sensors", "pipeline")
        for file in sources(folder)
        if file.name == "__init__.py"
    }
    assert [file for file, text in described.items() if text.count(".") < 2] == []


@pytest.mark.parametrize("file", sources("pipeline"), ids=lambda file: str(file.relative_to(ROOT)))
def test_nothing_in_the_pipeline_is_decided_by_the_name_of_an_effect(file: Path) -> None:
    """Knowledge of an effect belongs to its class; an algorithm that is made for one effect refers to the class."""
    names = {path.stem for path in (ROOT / "sensors" / "effects").glob("*.py")}
    names |= {f"{sensor}.{name}" for sensor in ("tls", "stereo") for name in names}
    written = {node.value for node in nodes_of(file.read_text()) if isinstance(node, ast.Constant)}
    assert written & names == set()


OF_OTHERS = {"_exit", "_actions", "_repr_html_"}
"""Names that begin with an underscore and are public: of os, of argparse, of Jupyter's protocol."""


def private_of_others(source: str) -> set[str]:
    """Return names with a leading underscore that a module imports from another one, or uses of an object of another class."""
    nodes = nodes_of(source)
    own = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    own |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    own |= {node.attr for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)}
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute)} - own
    used |= {alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names}
    return {name for name in used if name.startswith("_") and not name.startswith("__")} - OF_OTHERS


@pytest.mark.parametrize("folder", ["scene", "sensors", "pipeline"])
def test_what_is_private_stays_in_its_module(folder: str) -> None:
    found = {str(file.relative_to(ROOT)): private_of_others(file.read_text()) for file in sources(folder)}
    assert {file: names for file, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "line", ["from sensors.laser.tls import _extent", "scanner._aimed()", "class A(B):\n    def f(self):\n        super()._g()"]
)
def test_the_rule_sees_what_is_private(line: str) -> None:
    assert private_of_others(line)


def test_no_two_classes_have_one_name() -> None:
    places: dict[str, list[str]] = {}
    for folder in ("scene", "sensors", "pipeline"):
        for file in sources(folder):
            for node in nodes_of(file.read_text()):
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name, []).append(str(file.relative_to(ROOT)))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text()


def test_the_page_on_the_architecture_names_every_room_and_only_files_that_there_are() -> None:
    known = {file.name for folder in ("scene", "sensors", "pipeline", "tests") for file in sources(folder)}
    for name in re.findall(r"`([\w/]+\.py)`", PAGE):
        assert (ROOT / name).is_file() or (ROOT / "pipeline" / name).is_file() or ("/" not in name and name in known), name
    rooms = {path.name for path in (ROOT / "pipeline").iterdir() if (path / "__init__.py").is_file()}
    assert rooms <= {name.removesuffix("/") for name in re.findall(r"`([\w/]+/)`", PAGE)}


def test_the_architecture_fits_on_a_page() -> None:
    assert len(PAGE.splitlines()) <= 80


def test_the_page_lists_the_rooms_in_the_order_of_their_needs() -> None:
    rows = [line for line in PAGE.splitlines() if re.match(r"\| `\w+/`", line)]
    listed = [re.findall(r"`(\w+)/`", row.split("|")[1]) for row in rows]
    place = {f"pipeline.{room}": number for number, names in enumerate(listed) for room in names}
    later = {
        (room, needed)
        for room, others in room_edges(modules()).items()
        for needed in others
        if room.startswith("pipeline.") and needed.startswith("pipeline.")
        if place[".".join(needed.split(".")[:2])] > place[".".join(room.split(".")[:2])]
    }
    assert later == set()

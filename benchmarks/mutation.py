"""Measure how many small faults in drawn lines the tests notice, and how many lines and branches they reach.

Run `python benchmarks/mutation.py reach` first: it carries out the tests under coverage.py and records which test reaches which
line. Then `python benchmarks/mutation.py mutate` changes one drawn line at a time, runs the tests that reach it, and counts how
often one fails. Both keep their figures in docs/validation/coverage.json; `page` writes docs/validation/coverage.md from it.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
RECORD, PAGE = ROOT / "docs" / "validation" / "coverage.json", ROOT / "docs" / "validation" / "coverage.md"
PARTS = ("scene", "sensors", "pipeline/change")
"""Folders from which the lines to change are drawn."""
ALL = "all together"
REACHED = Path("runs") / "reach.sqlite"
"""Data of coverage.py, relative to the checkout."""
TESTS_A_LINE, SECONDS_A_LINE = 25, 240.0
"""At most so many tests, and so much time, for one changed line; the tests that reach the fewest lines come first."""
PACKAGES = (
    "numpy",
    "scipy.spatial",
    "scipy.ndimage",
    "pydantic",
    "cv2",
    "trimesh",
    "matplotlib.pyplot",
    "laspy",
    "mitsuba",
    "hypothesis",
)
"""What is imported once, before the processes that run the tests are forked."""
_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.USub: ast.UAdd,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}


@dataclass(frozen=True)
class Mutation:
    """One small fault. file: relative to the checkout; number: which of the file's possible faults; before, after: the line."""

    file: str
    line: int
    number: int
    before: str
    after: str


@dataclass(frozen=True)
class Outcome:
    """What the tests said of a mutation: `caught`, `survived`, `unreached` or `time limit`; test: the one that failed."""

    mutation: Mutation
    said: str
    test: str = ""
    seconds: float = 0.0


def places(source: str) -> list[tuple[int, int]]:
    """Return line and node number of each place for a small fault: an operator, number, truth value, condition or statement."""
    tree = ast.parse(source)
    skipped = {id(node) for part in _without_effect(tree) for node in ast.walk(part)}
    nodes = ((number, node) for number, node in enumerate(ast.walk(tree)) if id(node) not in skipped)
    return [(node.lineno, number) for number, node in nodes if hasattr(node, "lineno") and _fault(node) is not None]


def changed_source(source: str, number: int) -> str:
    """Return a source with the fault in the node of a number."""
    tree = ast.parse(source)
    node = next(each for index, each in enumerate(ast.walk(tree)) if index == number)
    fault = _fault(node)
    assert fault is not None
    setattr(node, *fault)
    return ast.unparse(tree)


def _without_effect(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield what has no effect on results: annotations, decorators, imports, docstrings and messages."""
    for node in ast.walk(tree):
        yield from filter(None, (getattr(node, "annotation", None), getattr(node, "returns", None)))
        yield from getattr(node, "decorator_list", ())
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield node
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield node
        if isinstance(node, (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)):
            yield node


def _fault(node: ast.AST) -> tuple[str, Any] | None:
    """Return the attribute of a node that a fault changes, and its new value; None where there is none."""
    match node:
        case ast.BinOp() | ast.BoolOp() | ast.UnaryOp() | ast.AugAssign() if type(node.op) in _SWAPS:
            return "op", _SWAPS[type(node.op)]()
        case ast.Compare() if type(node.ops[0]) in _SWAPS:
            return "ops", [_SWAPS[type(node.ops[0])](), *node.ops[1:]]
        case ast.Constant(value=bool(value)):
            return "value", not value
        case ast.Constant(value=int(value) | float(value)):
            return "value", value * 2 if abs(value) > 1 else value + 1
        case ast.If() | ast.IfExp():
            return "test", ast.UnaryOp(ast.Not(), node.test)
        case ast.Return(value=ast.expr()) | ast.Expr(value=ast.Call()):
            return "value", ast.Constant(None)
    return None


def drawn(count: int, seed: int) -> list[Mutation]:
    """Draw lines among all that can hold a fault, and one fault on each."""
    by_line: dict[tuple[str, int], list[int]] = {}
    for part in PARTS:
        for path in sorted((ROOT / part).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            for line, number in places(path.read_text(encoding="utf-8")):
                by_line.setdefault((name, line), []).append(number)
    chance = random.Random(seed)
    lines = chance.sample(sorted(by_line), count)
    return [_mutation(file, line, chance.choice(by_line[file, line])) for file, line in lines]


def _mutation(file: str, line: int, number: int) -> Mutation:
    """Describe a fault by the line before and after, both as Python itself writes them."""
    source = (ROOT / file).read_text(encoding="utf-8")
    before, after = (text.splitlines() for text in (ast.unparse(ast.parse(source)), changed_source(source, number)))
    at = next((index for index, (old, new) in enumerate(zip(before, after, strict=False)) if old != new), 0)
    return Mutation(file, line, number, before[at].strip(), after[at].strip())


def reach(tests: list[str]) -> dict[str, Any]:
    """Carry out tests under coverage.py, one context a test; return the shares of lines and branches that they reach."""
    REACHED.parent.mkdir(exist_ok=True)
    settings = REACHED.with_suffix(".ini")
    settings.write_text(f"[run]\nbranch = true\nsource = scene,sensors,pipeline\ndata_file = {REACHED}\n")
    words = ["run", f"--rcfile={settings}", "-m", "pytest", "-n", "0", "-m", "not validation", "-p", "coverage_contexts"]
    folders = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": folders}
    subprocess.run([sys.executable, "-m", "coverage", *words, *tests], env=environment, check=False)
    report = REACHED.with_suffix(".json")
    subprocess.run([sys.executable, "-m", "coverage", "json", f"--rcfile={settings}", "-q", "-o", report], check=True)
    return shares(json.loads(report.read_text())["files"])


def shares(files: dict[str, Any]) -> dict[str, Any]:
    """Add up coverage.py's counts of files by package and, in `pipeline`, by folder; the last entry is the sum of all."""
    keys = ("num_statements", "covered_lines", "num_branches", "covered_branches")
    found: dict[str, dict[str, int]] = {}
    for name in sorted(files):
        folders = Path(name).parts
        part = "/".join(folders[:2]) if folders[0] == "pipeline" and len(folders) > 2 else folders[0]
        for sums in (found.setdefault(part, dict.fromkeys(keys, 0)), found.setdefault(ALL, dict.fromkeys(keys, 0))):
            for key in keys:
                sums[key] += files[name]["summary"][key]
    return {part: found[part] for part in sorted(found, key=lambda part: (part == ALL, part))}


def tests_of(file: str, line: int) -> list[str]:
    """Return the tests that reach a line, those that reach the fewest lines first.

    A line that runs when its module is imported has no test of its own; the tests that reach other lines of the file count, and
    the test modules that import it.
    """
    from coverage import CoverageData

    data = CoverageData(str(REACHED))
    data.read()
    contexts = data.contexts_by_lineno(str(ROOT / file))
    found = {name for name in contexts.get(line, []) if name}
    if not found:
        found = {name for names in contexts.values() for name in names if name}
        module = file.removesuffix(".py").replace("/", ".")
        tests = (path for path in (ROOT / "tests").rglob("test_*.py") if f"from {module} import" in path.read_text("utf-8"))
        found |= {str(path.relative_to(ROOT)) for path in tests}
    widths = dict.fromkeys(found, 0)
    for name in widths:
        data.set_query_contexts([f"^{_escaped(name)}$"])
        widths[name] = sum(len(data.lines(each) or ()) for each in data.measured_files())
    return sorted(widths, key=lambda name: (widths[name], name))


def _escaped(name: str) -> str:
    """Escape a test's name for a regular expression."""
    return "".join(letter if letter.isalnum() or letter in "_/" else f"\\{letter}" for letter in name)


def outcome(mutation: Mutation, further: Sequence[str] = ()) -> Outcome:
    """Run the tests that reach the line, and further ones first, on a copy of the checkout that has the fault."""
    tests = [*further, *tests_of(mutation.file, mutation.line)[:TESTS_A_LINE]]
    if not tests:
        return Outcome(mutation, "unreached")
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "checkout"
        left_out = shutil.ignore_patterns(".git", ".venv", ".uv", "runs", "__pycache__")
        shutil.copytree(ROOT, copied, ignore=left_out, symlinks=True)
        path = copied / mutation.file
        path.write_text(changed_source(path.read_text(encoding="utf-8"), mutation.number), encoding="utf-8")
        said, failed = _tested(copied, tests)
    return Outcome(mutation, said, failed, time.perf_counter() - start)


def _tested(checkout: Path, tests: list[str]) -> tuple[str, str]:
    """Run tests of a checkout in a fork of this process, which has imported the large packages; say how they ended."""
    log = checkout.with_suffix(".log")
    child = os.fork()
    if child == 0:
        with log.open("w") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
        os.chdir(checkout)
        sys.path.insert(0, str(checkout))
        os.environ["PYTHONPATH"] = str(checkout)
        os._exit(pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not validation", *tests]))
    end = time.monotonic() + SECONDS_A_LINE
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            failed = (each.split()[1] for each in log.read_text().splitlines() if each.startswith(("FAILED ", "ERROR ")))
            return ("survived", "") if os.waitstatus_to_exitcode(status) == 0 else ("caught", next(failed, ""))
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "time limit", ""


def page(record: dict[str, Any]) -> str:
    """Return the page, made from the record."""
    lines = [
        "# What the tests reach, and what they notice",
        "",
        "This page is for developers. It says which share of the code the tests reach, and how many small faults they notice.",
        "",
        "## Lines and branches",
        "",
        'A line is "reached" if a test executes it, a branch if a test takes it (each `if` has two). The columns have the',
        "number of lines and branches of a folder and the share that is reached.",
        "",
        f"Measured with coverage.py at commit {record['reach']['commit']} with {_words(record['reach']['tests'])}.",
        "",
        "| part | lines | reached | branches | reached |",
        "|---|---|---|---|---|",
    ]
    for part, found in record["reach"]["parts"].items():
        lines_of, reached, branches, taken = found.values()
        name = part if part == ALL else f"`{part}`"
        lines.append(f"| {name} | {lines_of:,} | {_share(reached, lines_of)} | {branches:,} | {_share(taken, branches)} |")
    outcomes = record["mutate"]["outcomes"]
    caught = sum(each["said"] == "caught" for each in outcomes)
    equal = sum(each.get("remark", "").startswith("equal") for each in outcomes)
    lines += [
        "",
        "## Faults that the tests notice",
        "",
        f"{len(outcomes)} lines were drawn (seed {record['mutate']['seed']}, commit {record['mutate']['commit']}), and each was",
        "changed in one place: another operator, number or truth value, or a statement left out. For each, at most",
        f"{TESTS_A_LINE} of the tests that reach it were run, for at most {SECONDS_A_LINE:.0f} s.",
        f"**{caught} of {len(outcomes)} faults were noticed.** {equal} of the others change no result; no test can notice them;",
        f"without these it is {_share(caught, len(outcomes) - equal)}. Tests that were written after the draw count too.",
        "The aim is 80 %. Lines that none of these tests reaches were tried with other tests of `make test`.",
        "",
        "The table has the faults that no test noticed: the file and line, the line before and after the change, and why.",
        '"Survived" means that all tests passed, "unreached" that no test reaches the line, "time limit" that the time was up',
        'before a test failed, and "equal" that the change makes no difference to any result.',
        "",
        "| not noticed | line | changed to | why |",
        "|---|---|---|---|",
    ]
    for each in outcomes:
        if each["said"] != "caught":
            of = each["mutation"]
            code = (f"`{text}`".replace("|", "\\|") for text in _excerpts(of["before"], of["after"]))
            lines.append(f"| `{of['file']}:{of['line']}` | {' | '.join(code)} | {each.get('remark') or each['said']} |")
    lines += ["", "Written by `python benchmarks/mutation.py page`.", ""]
    return "\n".join(lines)


def _excerpts(before: str, after: str) -> tuple[str, str]:
    """Return where two lines differ, with a few characters round it."""
    at = next((place for place, (old, new) in enumerate(zip(before, after, strict=False)) if old != new), 0)
    part = slice(max(at - 45, 0), at + 45)
    return before[part].strip(), after[part].strip()


def commit() -> str:
    """Return the checkout's commit, shortened."""
    return subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def _words(tests: list[str]) -> str:
    """Say which tests were carried out."""
    return "all tests of `make test`" if tests == ["tests"] else ", ".join(f"`{name}`" for name in tests)


def _share(part: int, whole: int) -> str:
    """Return a share in per cent."""
    return f"{100 * part / max(whole, 1):.0f} %"


def _update(key: str, value: dict[str, Any]) -> None:
    """Put a part into the record."""
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    RECORD.write_text(json.dumps(record | {key: value}, indent=1) + "\n")


def mutate(lines: int, seed: int) -> None:
    """Try a fault on each of the drawn lines."""
    outcomes: list[dict[str, Any]] = []
    for mutation in drawn(lines, seed):
        outcomes.append(asdict(outcome(mutation)))
        _say(len(outcomes), outcomes[-1])
        _update("mutate", {"commit": commit(), "seed": seed, "outcomes": outcomes})


def again(tests: list[str]) -> None:
    """Try the faults once more that were not noticed, with further tests."""
    record = json.loads(RECORD.read_text())["mutate"]
    for number, each in enumerate(record["outcomes"]):
        if each["said"] != "caught":
            each |= asdict(outcome(Mutation(**each["mutation"]), [name for name in tests if name != "tests"]))
            _say(number, each)
            _update("mutate", record)


def _say(number: int, found: dict[str, Any]) -> None:
    """Print an outcome."""
    of = found["mutation"]
    print(f"{number} {found['said']} {of['file']}:{of['line']}  {of['before']}  ->  {of['after']}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("reach", "mutate", "again", "page"))
    parser.add_argument("--tests", nargs="+", default=["tests"], help="what `reach` runs, or `again` runs in addition")
    parser.add_argument("--lines", type=int, default=100)
    parser.add_argument("--seed", type=int, default=50)
    given = parser.parse_args()
    if given.what == "reach":
        _update("reach", {"commit": commit(), "tests": given.tests, "parts": reach(given.tests)})
    if given.what == "mutate":
        for name in PACKAGES:
            importlib.import_module(name)
        mutate(given.lines, given.seed)
    if given.what == "again":
        again(given.tests)
    if given.what == "page":
        PAGE.write_text(page(json.loads(RECORD.read_text())), encoding="utf-8")


if __name__ == "__main__":
    main()

"""`scarpsim doctor`: it is right about this machine, and works where packages are missing."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from pipeline.cli import doctor, system_libraries
from pipeline.cli.main import main


def test_this_machine_is_ready(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = {finding["name"]: finding for finding in told["findings"]}
    assert told["ready"] is True
    assert re.fullmatch(rf"{metadata.version('numpy')}, \d\d MB", found["numpy"]["found"])
    assert found["extra poisson"]["found"].endswith("installed")
    assert re.fullmatch(r"[\d,]+ MB", found["all packages"]["found"])
    assert found["Mitsuba variant"]["found"].split()[0] in ("llvm_ad_mono", "cuda_ad_mono")
    assert {"Python", "mitsuba", "CPU threads", "memory", "disk space here", "compiled kernels", "CUDA device"} <= set(found)


def test_missing_things_are_told_with_their_remedy(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    absent = system_libraries.SystemLibrary("libnonesuch.so.7", "libnonesuch7", "nobody")
    monkeypatch.setattr(system_libraries, "LIBRARIES", (absent,))
    monkeypatch.setattr(metadata, "requires", lambda _: ["nonesuch>=3", "numpy>=1000", "psutil; extra == 'detect'", "rich>=14"])
    monkeypatch.setitem(sys.modules, "rich", None)
    monkeypatch.setitem(sys.modules, "psutil", None)
    assert main(["doctor"]) == 1
    lines = {line[8:40].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert lines["libnonesuch.so.7"].startswith("PROBLEM")
    assert lines["libnonesuch.so.7"].endswith("apt-get install -y --no-install-recommends libnonesuch7")
    assert "not installed, needs >=3; run `make setup`" in lines["nonesuch"]
    assert "needs >=1000" in lines["numpy"]
    assert "does not load: ModuleNotFoundError" in lines["rich"]
    assert "ModuleNotFoundError" in lines["machine"]


def test_an_extra_that_is_not_there_is_no_problem_and_says_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "requires", lambda _: ["nonesuch>=3; extra == 'detect'", "numpy; extra == 'm3c2'"])
    found = {finding.name: finding for finding in doctor._extras()}
    assert found["extra detect"].ok is None
    assert "not installed: nonesuch, 2.0 GB" in found["extra detect"].found
    assert found["extra detect"].remedy.startswith("make setup EXTRAS=detect, in /")
    assert found["extra m3c2"].found.endswith("installed")
    assert not found["extra m3c2"].remedy


def test_the_libraries_of_an_extra_are_wanted_with_it_only(monkeypatch: pytest.MonkeyPatch) -> None:
    absent = system_libraries.SystemLibrary("libnonesuch.so.7", "libnonesuch7", "Open3D", "poisson")
    monkeypatch.setattr(system_libraries, "LIBRARIES", (absent,))
    assert system_libraries.missing() == []
    assert system_libraries.missing(["poisson"]) == [absent]
    monkeypatch.setattr(doctor, "_is_installed", lambda _: False)
    assert list(doctor._libraries()) == []


def test_a_probe_that_fails_is_a_finding() -> None:
    def explode() -> None:
        raise ZeroDivisionError("by nought")

    (finding,) = doctor._run_probe(explode)
    assert (finding.name, finding.ok, finding.found) == ("explode", False, "ZeroDivisionError: by nought")


def test_llvm_is_looked_for_where_drjit_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM.so")
    (library,) = (library for library in system_libraries.LIBRARIES if library.soname == system_libraries.LLVM)
    assert not library.present
    (package,) = system_libraries.packages([library])
    assert package.startswith("libllvm")


def test_the_set_up_can_ask_for_missing_packages_with_a_bare_python() -> None:
    """tools/setup.sh does so before the environment exists: no package is needed, and none of our modules hides a library's."""
    script = Path(__file__).parents[2] / "pipeline/cli/system_libraries.py"
    result = subprocess.run([sys.executable, "-P", "-S", str(script)], capture_output=True, text=True, check=False, env={})
    assert result.returncode == 0, result.stderr
    assert f"-P {script.relative_to(script.parents[2])}" in (script.parents[2] / "tools/setup.sh").read_text()

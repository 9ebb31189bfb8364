"""Records and measurements with odd values at any place: their reader accepts them or refuses them with one line.

FUZZ_EXAMPLES sets the number of cases of each kind: 25 here, 500 in benchmarks/fuzz.py.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from gap_cases import write_scan
from hypothesis import given
from hypothesis import strategies as st
from test_fuzz import ODD, QUICK, answered, places

from pipeline.dataset.records import _digest, _text, read_dataset_file
from pipeline.detection.inference.weights import CONFIG, load_config
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.records.result_records import read_gap, read_run

BLOCK = {
    "label": 1,
    "shape": "cube",
    "size_m": [0.4, 0.4, 0.4],
    "volume_m3": 0.06,
    "bbox_m": [1.0, 1.0, 0.0, 1.4, 1.4, 0.4],
    "position_m": [1.2, 1.2, 0.2],
    "measured_area_m2": 0.1,
    "measured_volume_m3": 0.03,
    "measured_mean_depth_m": None,
}
EPOCH = {
    "epoch": 1,
    "registration": {"rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "translation_m": [0.0, 0.0, 0.1]},
    "statistics": {"sigma_m": 0.003},
    "blocks": [BLOCK],
}
RUN = {
    "schema": 1,
    "sensor": "tls",
    "config": {"seed": 1},
    "wall": {"name": "ledge"},
    "epochs": [{"epoch": 0, "blocks": []}, EPOCH],
    "products": {"epoch_000": {"epoch_000/points.laz": "0"}},
}
GAP = {"sensor": "tls", "verdict": "no_gap", "scene_changes": [{"bbox_m": [0.0, 0.0, 0.0, 1.0, 1.0, 1.0], "volume_m3": 0.1}]}
SOURCE = {"config": {"name": "tiny"}, "versions": {"numpy": "2"}, "command": "scarpsim dataset", "prefix": ""}
DATASET = {
    "schema": 1,
    "name": "tiny",
    "fingerprint": "0123456789ab",
    "complete": True,
    "sources": {"0123456789ab": SOURCE},
    "epochs": {"0123456789ab": [0, 1]},
}
DETECTOR = {"backbone": "fine", "image_px": 512, "proposal": {"anchor_sizes_px": [6.0, 12.0, 24.0, 56.0, 128.0]}, "head": {}}


def signed(values: Any) -> Any:
    """Return dataset.json with a right checksum of its contents."""
    try:
        return {**values, "sha256": _digest(_text(values))} if isinstance(values, dict) else values
    except ValueError:  # NaN and infinity
        return values


RECORDS: dict[str, tuple[Any, str, Callable[[Path], Any], Callable[[Any], Any]]] = {
    "run": (RUN, "run.json", lambda path: read_run(path, "run it again"), lambda values: values),
    "gap": (GAP, "gap.json", read_gap, lambda values: values),
    "dataset": (DATASET, "dataset.json", lambda path: read_dataset_file(path.parent), signed),
    "detector": (DETECTOR, CONFIG, lambda path: load_config(path.parent), lambda values: values),
}


def odd(values: Any, data: st.DataObject) -> Any:
    """Return a copy with a value of another kind, without one key, or replaced by something else altogether."""
    result = copy.deepcopy(values)
    path = data.draw(st.sampled_from([(), *places(result)]))
    if not path:
        return data.draw(ODD)
    holder = result
    for key in path[:-1]:
        holder = holder[key]
    if data.draw(st.booleans()):
        holder[path[-1]] = data.draw(ODD)
    else:
        del holder[path[-1]]
    return result


@pytest.mark.parametrize("kind", RECORDS)
@QUICK
@given(data=st.data())
def test_a_record_with_an_odd_value(kind: str, tmp_path: Path, data: st.DataObject) -> None:
    good, name, read, finished = RECORDS[kind]
    file = tmp_path / name
    text = json.dumps if file.suffix == ".json" else yaml.safe_dump
    file.write_text(text(finished(good)))
    read(file)
    file.write_text(text(finished(odd(good, data))), encoding="utf-8", errors="surrogatepass")
    answered(lambda: read(file))


@pytest.fixture(scope="module")
def measurement(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("measurement")
    write_scan(folder, 1, step_rad=0.02)
    return folder


@QUICK
@given(name=st.sampled_from(["measurement.yaml", "model.yaml"]), data=st.data())
def test_a_measurement_with_an_odd_value(name: str, measurement: Path, data: st.DataObject) -> None:
    """A changed value may be valid: then the measurement is read."""
    file = measurement / name
    before = file.read_text()
    try:
        file.write_text(yaml.safe_dump(odd(yaml.safe_load(before), data), allow_unicode=True), errors="surrogatepass")
        answered(lambda: read_measurement(measurement))
    finally:
        file.write_text(before)

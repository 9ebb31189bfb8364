"""The study of ICP: the true transform against a planted one, errors against closed forms, and the recommendations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from surfaces import heightfield

from pipeline.cli.main import main
from pipeline.icp_study.report import write_icp_study
from pipeline.icp_study.results import Recommendation, StudyRow
from pipeline.icp_study.study import EpochSurfaces, recommend, study, true_pose
from pipeline.registration.register import IcpConfig
from pipeline.registration.rigid import RigidTransform
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh

pytestmark = pytest.mark.usefixtures("undrawn")

SIGMA = 0.003


def measured(wall: TriangleMesh, seed: int, pose: RigidTransform | None = None) -> TriangleMesh:
    """Return the wall's vertices with noise across the wall's plane, moved by `pose`."""
    noise = KeyedRandom(seed).generator().normal(0, SIGMA, len(wall.vertices))
    points = wall.vertices + np.stack([np.zeros(len(noise)), np.zeros(len(noise)), noise], axis=1)
    return wall.with_vertices(points if pose is None else pose.apply(points))


PLANTED = RigidTransform.about(np.zeros(3), np.array([2e-4, -3e-4, 1e-4]), np.array([0.004, -0.003, 0.008]))


@pytest.fixture(scope="module")
def wall() -> TriangleMesh:
    return heightfield(5.0, 4.0, 0.05, roughness=0.15)


def test_the_true_pose_is_the_planted_one(wall: TriangleMesh) -> None:
    """The true pose is found to the precision that the points allow.

    8,000 points with 3 mm of noise determine a shift across the wall to about 0.02 mm, and along it, by its roughness, to 0.1 mm.
    """
    found = true_pose(EpochSurfaces(1, measured(wall, 1, PLANTED), wall), KeyedRandom(1)).after(PLANTED)
    assert found.translation == pytest.approx(np.zeros(3), abs=5e-4)
    moved = found.apply(wall.vertices) - wall.vertices
    assert np.sqrt(np.mean(moved[:, 2] ** 2)) < 1e-4


def test_composition_is_in_order() -> None:
    first = RigidTransform.about(np.zeros(3), np.array([0.0, 0.0, np.pi / 2]), np.zeros(3))
    second = RigidTransform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    assert second.after(first).apply(np.array([1.0, 0.0, 0.0])) == pytest.approx([1.0, 1.0, 0.0])


def test_a_study_of_a_planted_displacement(wall: TriangleMesh, tmp_path: Path) -> None:
    surfaces = [
        EpochSurfaces(0, measured(wall, 2), wall),
        EpochSurfaces(1, measured(wall, 3, PLANTED), wall, applied=PLANTED.inverse()),
        EpochSurfaces(2, measured(wall, 4), wall, applied=RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.01]))),
    ]
    found = study("tls", surfaces, IcpConfig(), KeyedRandom(1), repeats=1)
    assert found.sigma_m == pytest.approx(
        np.sqrt(2) * SIGMA, rel=0.35
    )  # along normals; the nearest point is nearer than the own one
    good, wrong = found.applied[1], found.applied[2]
    assert good is not None
    assert wrong is not None
    assert good.normal_m < 2e-4
    assert wrong.displacement_m == pytest.approx(0.01, rel=0.03)
    assert wrong.translation_m == pytest.approx([0, 0, 0.01], abs=5e-4)
    every = [row for row in found.rows if row.parameter == "subsample_ratio" and row.value == 0]
    assert [row.epoch for row in every] == [1, 2]
    assert max(row.normal_error_m or 1.0 for row in every) < 3e-4
    narrow = next(row for row in found.rows if row.parameter == "outlier_distance_threshold" and not row.gradual)
    assert narrow.normal_error_m is None or narrow.normal_error_m > 3e-3  # 3 cm off, and a threshold of half the noise throughout
    report = write_icp_study(tmp_path / "study", found)
    assert report.read_text().count("<img") == 2
    assert (
        json.loads((tmp_path / "study/icp_study.json").read_text())["recommended"][1]["parameter"] == "outlier_distance_threshold"
    )
    assert len((tmp_path / "study/icp_study.csv").read_text().splitlines()) == len(found.rows) + 1


def row(parameter: str, value: float, error: float | None) -> StudyRow:
    return StudyRow(parameter, value, True, 1, 0, 0.01, error, error, 0.9, 5, 0.1)  # type: ignore[arg-type]


def test_what_is_recommended() -> None:
    ratios = [row("subsample_ratio", value, error) for value, error in [(0, 1e-3), (0.5, 1.05e-3), (0.9, 2e-3), (0.99, 0.9e-3)]]
    assert recommend(ratios, "subsample_ratio") == Recommendation("subsample_ratio", 0.5, (0, 0.5), 1.05e-3)
    errors = [(0.01, None), (0.02, 5e-3), (0.03, 1.02e-3), (0.04, 1e-3), (0.05, 1.05e-3), (0.1, 4e-3)]
    thresholds = [row("outlier_distance_threshold", *item) for item in errors]
    best = recommend(thresholds, "outlier_distance_threshold")
    assert best == Recommendation("outlier_distance_threshold", 0.04, (0.03, 0.05), 1e-3)
    assert recommend([row("outlier_distance_threshold", 0.1, None)], "outlier_distance_threshold") is None


@pytest.mark.parametrize(
    ("record", "words", "message"),
    [
        ("5", [], "run.json: the content must be a mapping"),
        (
            '{"sensor": "tls", "config": {}, "epochs": 3}',
            [],
            "run.json: keys or values are wrong: 'epochs': input should be a valid list",
        ),
        ('{"sensor": "tls", "config": {}, "epochs": [1, 2]}', [], "run.json: keys or values are wrong: 'epochs.0'"),
        (
            '{"sensor": "tls", "config": {}, "epochs": [{"epoch": 0}, {"epoch": 1, "registration": {"rotation": "x"}}]}',
            [],
            "run.json: keys or values are wrong: 'epochs.1.registration.rotation'",
        ),
        ("{", [], "run.json: the file is not JSON"),
        ('{"sensor": "tls", "config": {}, "epochs": [{"epoch": 0}]}', [], "no epoch after the reference"),
        ('{"sensor": "tls", "config": {}, "epochs": [{"epoch": 0}, {"epoch": 1}]}', ["--epochs", "99"], "allowed: 1 to 1"),
        ("{}", ["--offset-m", "1e300"], "allowed: 0 to 100 m"),
        ("{}", ["--offset-m", "nan"], "allowed: 0 to 100 m"),
        ("{}", ["--epochs", "1e9"], "a whole number from 1"),
    ],
)
def test_odd_records_and_options_are_one_line(
    tmp_path: Path, record: str, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.json").write_text(record)
    assert main(["icp-study", str(tmp_path), "--out", str(tmp_path / "out"), *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_without_a_run_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["icp-study", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "contains no run.json" in capsys.readouterr().err

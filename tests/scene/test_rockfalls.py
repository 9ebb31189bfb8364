"""Rocks that fall over time: laws against their formulas, volumes against the wall, fragments against gravity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from walls import plane_wall, rough_wall

from scene.blocks.block import RockfallConfig
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh, signed_volumes
from scene.ray_casting.raycast import RayCaster
from scene.series.config import DepositsConfig, EventConfig, MagnitudeFrequency, Motion, PrecursorConfig, RockfallRate, VolumeLaw
from scene.series.deposits import Ground
from scene.series.events import drawn_rockfalls, given_rockfalls, numbered
from scene.series.evolution import Rules, WallState, advanced
from scene.walls.safe_zone import safe_zone

RANDOM = KeyedRandom(5).child("series")
UP = np.array([0.0, 1.0, 0.0])


def rules(wall: TriangleMesh, events: list[dict[str, Any]], deposits: DepositsConfig | None = None) -> Rules:
    given = [parse(EventConfig, each, "test") for each in events]
    rockfalls = numbered(given_rockfalls(given, [each.after_h or 0.0 for each in given]))
    zone, shapes = safe_zone(RayCaster(wall), 0.3), RockfallConfig()
    return Rules(zone, shapes, deposits, Ground.below(wall, UP), rockfalls, RANDOM)


def volume_above(mesh: TriangleMesh, base_m: float) -> float:
    """Return the volume between a surface and z = base_m by prisms of its triangles (independent of scene/blocks)."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)[:, 2] / 2
    return float((area * ((a[:, 2] + b[:, 2] + c[:, 2]) / 3 - base_m)).sum())


def closed_volume(mesh: TriangleMesh) -> float:
    return float(signed_volumes(mesh.corners()).sum() / 6)


def test_volumes_follow_the_power_law_and_times_are_a_poisson_process() -> None:
    law = MagnitudeFrequency(exponent=0.7, smallest=0.01, largest=2.0)
    rate = RockfallRate(rate_per_day=40.0, volume_m3=VolumeLaw(power_law=law))
    found = drawn_rockfalls(rate, None, 24.0 * 100, RANDOM)
    assert len(found) == pytest.approx(4000, abs=4 * 4000**0.5)
    volumes = np.sort([each.volume_m3 for each in found])
    ends = 0.01**-0.7, 2.0**-0.7
    expected = (ends[0] - volumes**-0.7) / (ends[0] - ends[1])
    assert np.abs(expected - (np.arange(len(volumes)) + 0.5) / len(volumes)).max() < 1.95 / len(volumes) ** 0.5  # p = 0.001
    gaps = np.diff(np.sort([each.falls_h for each in found]))
    assert gaps.mean() == pytest.approx(0.6, rel=0.06)
    assert gaps.std() == pytest.approx(gaps.mean(), rel=0.08)  # exponential


def test_rockfalls_after_the_last_epoch_count_only_if_they_already_move() -> None:
    found = drawn_rockfalls(RockfallRate(rate_per_day=24.0), PrecursorConfig(share=0.5, lead_h=50.0), 100.0, RANDOM)
    late = [each for each in found if each.falls_h > 100]
    assert 10 < len(late) < 40
    assert all(each.motion is not None for each in late)


def test_the_inverse_of_the_velocity_falls_linearly_to_zero() -> None:
    motion = Motion(lead_h=100.0, displacement_m=0.05)
    left = np.array([90.0, 60.0, 30.0, 10.0, 3.0])
    step = 1e-4
    velocity = np.array([(motion.displacement(t - step) - motion.displacement(t + step)) / (2 * step) for t in left])
    assert 1 / velocity == pytest.approx(left * np.log(100.0) / 0.05, rel=1e-6)
    assert motion.displacement(1.0) == pytest.approx(0.05)
    for each in (motion, Motion(law="linear", lead_h=100.0, displacement_m=0.05)):
        assert each.time_left(each.displacement(40.0)) == pytest.approx(40.0)
        assert each.displacement(100.0) == 0.0


def test_niches_in_niches_balance_and_keep_labels_and_manifold() -> None:
    wall = rough_wall(6, 5, 0.05, seed=2)
    places = [[3.0 + 0.1 * (n % 3), 2.5 + 0.12 * (n // 3)] for n in range(8)]
    events = [{"after_h": 1.0 + n, "volume_m3": 0.03, "position_m": place} for n, place in enumerate(places)]
    series = rules(wall, events)
    base = float(wall.vertices[:, 2].min()) - 1.0
    before, state = volume_above(wall, base), WallState(0.0, wall)
    for hour in (1.5, 2.5, 3.5, 4.5, 8.5):
        state = advanced(state, hour, series)
        lost = sum(each.volume_m3 for each in state.loose)
        assert volume_above(state.base, base) + lost == pytest.approx(before, rel=1e-9)
        assert abs(state.balance_m3) < 1e-9 * before
    assert [each.volume_m3 for each in state.loose] == pytest.approx([0.03] * 8, rel=0.02)
    edges = np.sort(np.concatenate([state.base.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    assert state.base.face_block is not None
    assert {0, 8} <= set(np.unique(state.base.face_block).tolist()) <= set(range(9))
    deepest = wall.vertices[:, 2].min() - state.base.vertices[:, 2].min()
    one = advanced(WallState(0.0, wall), 1.5, series)
    assert deepest > 1.3 * (wall.vertices[:, 2].min() - one.base.vertices[:, 2].min())


def test_a_hundred_epochs_of_niches_in_niches_balance() -> None:
    wall = rough_wall(8, 6, 0.07, seed=4)
    law = VolumeLaw(power_law=MagnitudeFrequency(smallest=0.01, largest=0.3))
    motion = PrecursorConfig(share=0.3, lead_h=10.0)
    rockfalls = numbered(drawn_rockfalls(RockfallRate(rate_per_day=40.0, volume_m3=law), motion, 100.0, RANDOM))
    series = Rules(safe_zone(RayCaster(wall), 0.3), RockfallConfig(), None, Ground.below(wall, UP), rockfalls, RANDOM)
    base = float(wall.vertices[:, 2].min()) - 2.0
    before, state = volume_above(wall, base), WallState(0.0, wall)
    for hour in range(1, 101):
        state = advanced(state, float(hour), series)
        lost = sum(each.volume_m3 for each in state.loose)
        assert volume_above(state.base, base) + lost == pytest.approx(before, rel=1e-9)
    assert len(state.fallen) > 130
    edges = np.sort(np.concatenate([state.base.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2


def test_a_block_moves_out_along_the_normal_before_it_falls() -> None:
    wall = plane_wall(6, 5)
    motion = {"law": "linear", "lead_h": 10.0, "displacement_m": 0.04}
    series = rules(wall, [{"after_h": 20.0, "volume_m3": 0.05, "position_m": [3.0, 2.5], "precursor": motion}])
    state, heights = WallState(0.0, wall), []
    for hour in (9.0, 15.0, 19.0, 21.0):
        state = advanced(state, hour, series)
        caster = RayCaster(state.mesh(series))
        distance, face = caster.cast(np.array([[3.0, 2.5, 5.0]]), np.array([[0.0, 0.0, -1.0]]))
        label = 0 if caster.mesh.face_block is None else int(caster.mesh.face_block[face[0]])
        heights.append((5.0 - float(distance[0]), label))
    assert [label for _, label in heights] == [0, 2, 2, 1]
    assert [height for height, _ in heights[:3]] == pytest.approx([0.0, 0.02, 0.036], abs=1e-6)
    assert heights[3][0] < -0.05


def test_fragments_have_the_rocks_volume_and_lie_at_rest_apart() -> None:
    wall = rough_wall(8, 6, 0.1, seed=3)
    config = DepositsConfig(fragments=6)
    series = rules(wall, [{"after_h": 1.0, "volume_m3": 0.2}, {"after_h": 2.0, "volume_m3": 0.1}], config)
    state = advanced(advanced(WallState(0.0, wall), 1.5, series), 2.5, series)
    assert len(state.deposits) == 2
    for rock, deposit in zip(state.loose, state.deposits, strict=True):
        assert closed_volume(deposit.mesh) == pytest.approx(rock.volume_m3, rel=1e-9)
    circles = np.concatenate([each.circles for each in state.deposits])
    apart = np.linalg.norm(circles[:, None, :2] - circles[None, :, :2], axis=2) - circles[:, None, 2] - circles[None, :, 2]
    assert apart[~np.eye(len(circles), dtype=bool)].min() > -1e-9
    caster, toe = RayCaster(state.base), wall.vertices[:, 1].min()
    for deposit in state.deposits:
        parts = trimesh.Trimesh(deposit.mesh.vertices, deposit.mesh.faces, process=False).split()
        assert len(parts) == 6
        for part in (np.array(each.vertices) for each in parts):
            on_ground = part[:, 1].min() - toe
            distance, _ = caster.cast(part, np.tile(-UP, (len(part), 1)))
            assert min(on_ground, np.nanmin(np.append(distance, np.inf))) == pytest.approx(0.0, abs=1e-4)
            assert on_ground > -1e-9


def test_what_has_no_room_is_said() -> None:
    wall = plane_wall(4, 3)
    with pytest.raises(InputError, match=r"no block of 0.1 m3 can be cut out at \(40, 2\) m"):
        advanced(WallState(0.0, wall), 2.0, rules(wall, [{"after_h": 1.0, "volume_m3": 0.1, "position_m": [40.0, 2.0]}]))
    with pytest.raises(InputError, match="no room was found for a block of 500 m3"):
        advanced(WallState(0.0, wall), 2.0, rules(wall, [{"after_h": 1.0, "volume_m3": 500.0}]))
    with pytest.raises(InputError, match="needs either `time` or `after_h`"):
        parse(EventConfig, {"volume_m3": 0.1}, "test")


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, 0.8, 0.6), (0.48, 0.6, 0.64), (0.0, 0.0, 1.0)])
def test_the_ground_is_level_and_leads_away_from_the_wall(up: tuple[float, float, float]) -> None:
    wall = rough_wall(6.0, 4.0, 0.2)
    ground = Ground.below(wall, np.array(up))
    axes = np.stack([ground.up, ground.outward, ground.aside])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert ground.outward[2] > 0 or up[2] == 1.0
    heights = wall.vertices @ np.array(up)
    assert ground.level_m == heights.min()

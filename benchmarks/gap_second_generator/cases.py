"""Define each case by seed and number: kind and effects, its folder, and the truth kept outside of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import folder, laser, laser_effects, stereo, stereo_effects, walls
from .effects import Parameters
from .frames import Frame
from .surface import Array, Surface

Rng = np.random.Generator
DECK = ["none"] * 4 + ["change"] * 2 + ["off"] * 4 + ["two"] * 3 + ["one"] * 7
WEAKEST, STRONGEST = 6.0, 100.0
SENSORS = ("tls", "stereo")
NEEDS_POWER = {"range_intensity_bias", "range_noise_intensity", "detection_limit", "bright_step"}
NEEDS_PATTERN = {"detection_limit", "precipitation", "blind_sector"}
BY_FRACTION = {"pixel_locking", "half_pixel_locking"}


@dataclass(frozen=True)
class Case:
    """Number, sensor, kind (none, change, off, two, one), and names of its effects."""

    number: int
    sensor: str
    kind: str
    names: tuple[str, ...]


def schedule(seed: int, count: int, sensor: str | None = None) -> list[Case]:
    """`count` cases, of both sensors in turn or of one; kinds from shuffled decks, effects from shuffled catalogues."""
    rngs = {each: np.random.default_rng([seed, 10 + SENSORS.index(each)]) for each in SENSORS}
    decks: dict[str, dict[str, list[str]]] = {each: {"kind": [], "one": [], "off": []} for each in SENSORS}
    cases = []
    for number in range(count):
        this = sensor or SENSORS[number % 2]
        effects = laser_effects if this == "tls" else stereo_effects
        full = {"kind": DECK, "one": list(effects.CATALOGUE), "off": list(effects.OFF_CATALOGUE)}
        deal = _dealer(decks[this], rngs[this], full)
        kind = deal("kind")
        many = {"one": 1, "two": 2}.get(kind, 0)
        names = [deal("one") for _ in range(many)] if kind != "off" else [deal("off")]
        cases.append(Case(number, this, kind, tuple(dict.fromkeys(names))))
    return cases


def _dealer(decks: dict[str, list[str]], rng: Rng, full: dict[str, list[str]]) -> Any:
    def deal(name: str) -> str:
        if not decks[name]:
            decks[name] = [str(each) for each in rng.permutation(full[name])]
        return decks[name].pop()

    return deal


def build(case: Case, seed: int, where: Path, count: int | None = None) -> dict[str, Any]:
    """Write the measurement folder `where` and return the truth; `count`: approximate number of points (default: random)."""
    rng = np.random.default_rng([seed, case.number, SENSORS.index(case.sensor)])
    many = count or int(np.exp(rng.uniform(np.log(9e3), np.log(6e4))))
    where.mkdir(parents=True, exist_ok=True)
    moved = {"none": 0, "change": int(rng.integers(2, 5))}.get(case.kind, int(rng.integers(0, 4)))
    made = _laser(case, rng, many, moved, where) if case.sensor == "tls" else _stereo(case, rng, many, moved, where)
    return {"number": case.number, "sensor": case.sensor, "kind": case.kind, **made}


def _laser(case: Case, rng: Rng, many: int, moved: int, where: Path) -> dict[str, Any]:
    noise = laser.Noise(float(np.exp(rng.uniform(np.log(5e-4), np.log(4e-3)))), float(rng.uniform(1e-5, 6e-5)))
    if "beam_divergence" in case.names:
        many = min(many, 25000)
    site, pattern = laser.place(rng, many, noise, moved)
    losses = {"share": float(rng.uniform(0.0, 0.04)), "bushes": int(rng.integers(0, 4)), "gaps": int(rng.integers(0, 12))}
    losses["double_removed"] = bool(rng.random() < 0.3)
    if NEEDS_PATTERN & set(case.names):
        losses |= {"bushes": 0, "gaps": 0, "double_removed": False}
    seed = int(rng.integers(1 << 30))
    strength = laser.Strength(site, pattern, noise, seed, max(losses["share"], 0.005))
    effects, clear = _sized(case, laser, laser_effects.EFFECTS, strength, strength.shot, rng)
    scan = laser.scan(site, pattern, noise, effects, losses, seed)
    _write_laser(case, rng, site, pattern, noise, scan, where)
    truth = _truth(site, effects, clear, len(scan.points))
    return {**truth, "losses": losses, "sent": scan.sent, "noise": vars(noise)}


def _write_laser(
    case: Case, rng: Rng, site: laser.Site, pattern: laser.Pattern, noise: laser.Noise, scan: laser.Scan, where: Path
) -> None:
    world, patterned = bool(rng.random() < 0.3), bool(rng.random() < 0.75) or bool(NEEDS_PATTERN & set(case.names))
    fields = {"intensity": scan.power, "gps_time": scan.time}
    if rng.random() < 0.3:
        fields.pop("gps_time")
    bare = not NEEDS_POWER & set(case.names) and rng.random() < 0.2
    name = f"scan.{'xyz' if bare and rng.random() < 0.5 else 'ply'}"
    points = site.surveyed.outward(scan.points) if world else scan.points
    folder.write_points(where / name, points, {} if bare else fields)
    sheet: dict[str, Any] = {"sensor": "tls", "reference": "wall.ply", "points": name, "frame": "world" if world else "scanner"}
    sheet["scanner"] = {"position_m": site.surveyed.position.tolist(), "rotation": site.surveyed.rotation.tolist()}
    if patterned:
        ends = pattern.azimuth_step * (pattern.lines - 1), pattern.zenith_step * (pattern.pulses - 1)
        azimuth = [pattern.azimuth, pattern.azimuth + ends[0], pattern.azimuth_step]
        sheet["pattern"] = {"azimuth_rad": azimuth, "zenith_rad": [pattern.zenith, pattern.zenith + ends[1], pattern.zenith_step]}
    model = {"range_sigma_m": noise.range_m, "angle_sigma_rad": noise.angle_rad}
    _write_rest(where, site.reference, site.wall, sheet, model)


def _stereo(case: Case, rng: Rng, many: int, moved: int, where: Path) -> dict[str, Any]:
    step = float(rng.choice([24, 32, 48, 64]))
    noise = stereo.Noise(float(rng.uniform(0.12, 0.4)), float(rng.uniform(0.04, 0.15)), step, int(rng.choice([1, 3])))
    site = stereo.place(rng, moved, float(rng.uniform(0.02, 0.08)), bool(BY_FRACTION & set(case.names)))
    left = site.pair.left
    stride = float(max(round(np.sqrt(left.width * left.height / (1.2 * many))), 2))
    losses = {"share": float(rng.uniform(0.0, 0.06)), "bushes": int(rng.integers(0, 5))}
    strength = stereo.Strength(site, noise, stride)
    effects, clear = _sized(case, stereo, stereo_effects.EFFECTS, strength, strength.match, rng)
    cloud = stereo.reconstruct(site, noise, effects, losses, stride, int(rng.integers(1 << 30)))
    if "occlusion_fill" in effects:
        clear["occlusion_fill"]["ratio"] = float(np.sqrt(stereo.OUTLIER_Z2 * cloud.filled))
    _write_stereo(case, rng, site, noise, cloud, where)
    truth = _truth(site, effects, clear, len(cloud.points))
    return {**truth, "losses": losses, "noise": vars(noise), "stride_px": stride, "base_m": site.pair.base}


def _write_stereo(case: Case, rng: Rng, site: stereo.Site, noise: stereo.Noise, cloud: stereo.Cloud, where: Path) -> None:
    bare = rng.random() < 0.3
    name = f"surface.{'xyz' if bare and rng.random() < 0.3 else 'ply'}"
    pixels = {} if bare else {"pixel_x": cloud.pixels[:, 0], "pixel_y": cloud.pixels[:, 1]}
    folder.write_points(where / name, cloud.points, pixels)
    cameras = {"left": site.pair.left.to_dict(), "right": site.pair.right.to_dict()}
    (where / "cameras.yaml").write_text(folder.yaml_text(cameras))
    model = {"parallax_sigma_px": noise.white_px}
    model |= {"regularization_sigma_px": noise.grid_px, "regularization_step_px": noise.step_px}
    sheet = {"sensor": "stereo", "reference": "wall.ply", "points": name, "frame": "world", "cameras": "cameras.yaml"}
    _write_rest(where, site.reference, site.wall, sheet, model)


def _write_rest(where: Path, reference: Surface, wall: Frame, sheet: dict[str, Any], noise: dict[str, float]) -> None:
    model = {"sensor": sheet["sensor"], "noise": noise, "effects": []}
    folder.write_ply(where / "wall.ply", wall.outward(reference.vertices()), {}, reference.faces())
    (where / "measurement.yaml").write_text(folder.yaml_text({**sheet, "model": "model.yaml"}))
    (where / "model.yaml").write_text(folder.yaml_text(model))


def _sized(
    case: Case, sensor: Any, catalogue: Any, strength: Any, shot: Any, rng: Rng
) -> tuple[dict[str, Parameters], dict[str, dict[str, Any]]]:
    """Draw the parameters of each effect of the case, and state how clear the effect is.

    Its clarity is the wanted ratio, the reached ratio, and the distance from the nearest effect.
    """
    effects, clear = {}, {}
    for name in case.names:
        effect = catalogue[name]
        wanted = float(np.exp(rng.uniform(np.log(WEAKEST), np.log(STRONGEST))))
        parameters = sensor.size(effect, effect.draw(rng, shot), strength, wanted)
        effects[name] = parameters
        clear[name] = {"wanted": wanted, "ratio": strength.of(effect, parameters)}
        if effect.stage in ("range", "aim", "camera", "disparity"):
            apart, nearest = strength.apart(name, parameters, rng)
            clear[name] |= {"apart": apart, "nearest": nearest}
    return effects, clear


def _truth(site: Any, effects: dict[str, Parameters], clear: dict[str, dict[str, Any]], points: int) -> dict[str, Any]:
    """Return what the truths of both sensors contain."""
    error = {"kind": site.error.kind, "sigma_m": site.error.sigma, "patch_m": site.error.patch}
    moved = [_box(site, each) for each in site.changes]
    return {"effects": effects, "clear": clear, "changes": moved, "wall": site.kind, "error": error, "points": points}


def _box(site: Any, change: walls.Change) -> list[float]:
    """World box [x0, y0, z0, x1, y1, z1] of one change, m."""
    surface: Surface = site.truth
    x, z = np.meshgrid(surface.x, surface.z, indexing="ij")
    inside = (np.abs(x - change.x) < change.half_x) & (np.abs(z - change.z) < change.half_z)
    corners: Array = site.wall.outward(surface.vertices()[inside.ravel()])
    return [*map(float, corners.min(axis=0)), *map(float, corners.max(axis=0))] if len(corners) else []


def save_truth(truth: dict[str, Any], path: Path) -> None:
    """Write the truth as indented JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(truth, indent=1))

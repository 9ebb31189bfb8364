"""Scanner presets: conversions of the beam's divergence, precision never confused with accuracy, presets in configs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from pipeline.config.bundled import config_path, configs_folder
from pipeline.config.presets import read_preset
from pipeline.config.simulation import SimulationConfig, load_config
from scene.common.config import parse
from scene.common.errors import InputError
from sensors.effects.beam_divergence import BeamDivergence
from sensors.laser.presets import Divergence, ScannerPreset
from sensors.laser.tls import ScannerConfig
from sensors.models.sensor_model import TlsNoise

NAMES = ["faro_s350", "leica_p40", "leica_p50", "riegl_vz2000i", "riegl_vz400", "riegl_vz400i", "zf_5016"]
DEMO = configs_folder() / "demo.yaml"
PRECISION = {"value": 0.4, "at_m": 10, "kind": "precision", "source": "test"}


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """Write a config without any statement about sensors."""
    path = tmp_path / "bare.yaml"
    path.write_text("epochs: 1\n")
    return path


def test_the_presets_are_these() -> None:
    assert sorted(path.stem for path in (configs_folder() / "scanners").glob("*.yaml")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_every_preset_makes_an_instrument_and_a_model(name: str) -> None:
    preset = read_preset(name)
    low, high = preset.scanner().zenith_limits_rad
    assert 0 <= low < high <= np.pi
    assert preset.range_accuracy_mm is not None
    assert preset.model().noise.range_sigma_m < preset.range_accuracy_mm.value * 1e-3, "accuracy used as noise"
    assert preset.model().noise.angle_sigma_rad == TlsNoise().angle_sigma_rad, "no data sheet here gives a precision of angles"


@pytest.mark.parametrize(("level", "share"), [("1/e2", np.exp(-2)), ("1/e", np.exp(-1)), ("fwhm", 0.5)])
@pytest.mark.parametrize("angle", ["full", "half"])
def test_divergence_is_converted_as_a_gaussian_beam_has_it(level: str, share: float, angle: str) -> None:
    """Compared with the numerical root of exp(-2 r^2 / w^2) = share, for a beam with half angle w = 1 at 1/e^2."""
    radius = brentq(lambda r: np.exp(-2 * r**2) - share, 0, 3, xtol=1e-15)
    stated = Divergence(value=radius * (2 if angle == "full" else 1), level=level, angle=angle, source="test")
    assert stated.full_angle == pytest.approx(2.0, rel=1e-12)


def test_a_width_at_half_is_sqrt_two_ln_two_of_the_radius() -> None:
    """FWHM = w sqrt(2 ln 2), 1/e full width = w sqrt(2): Siegman, Lasers, ch. 17."""
    fwhm, at_e = (Divergence(value=1.0, level=level, angle="full", source="test").full_angle for level in ("fwhm", "1/e"))
    assert fwhm == pytest.approx(2 / np.sqrt(2 * np.log(2)), rel=1e-14)
    assert at_e == pytest.approx(np.sqrt(2), rel=1e-14)


def test_two_precisions_give_the_growth_of_the_noise_with_range() -> None:
    noise = read_preset("leica_p40").model().noise
    at = {range_m: np.hypot(noise.range_sigma_m, noise.range_ppm * 1e-6 * range_m) for range_m in (10.0, 50.0)}
    assert at == {10.0: pytest.approx(0.4e-3, rel=1e-12), 50.0: pytest.approx(0.5e-3, rel=1e-12)}


def test_the_beam_comes_as_an_effect_in_the_effects_own_convention() -> None:
    """0.3 mrad of half angle at 1/e^2 are 0.6 mrad of full angle; the pulse has 5 ns; without a divergence there is no effect."""
    assert [effect.model_dump() for effect in read_preset("zf_5016").model().effects] == [
        BeamDivergence(divergence_rad=0.6e-3, ranging="phase").model_dump()
    ]
    (pulsed,) = read_preset("riegl_vz400").model().effects
    assert pulsed == BeamDivergence(divergence_rad=0.3e-3, pulse_width_s=5e-9)
    assert read_preset("leica_p50").model().effects == ()


def preset(**figures: Any) -> ScannerPreset:
    return parse(ScannerPreset, {"name": "mine", **figures}, "mine.yaml")


def test_falling_and_steep_precisions_give_no_imaginary_noise() -> None:
    falling = preset(range_precision_mm=[PRECISION, {**PRECISION, "value": 0.3, "at_m": 50}]).model().noise
    assert (falling.range_sigma_m, falling.range_ppm) == (pytest.approx(0.4e-3), 0.0)
    steep = preset(range_precision_mm=[PRECISION, {**PRECISION, "value": 40, "at_m": 50}]).model().noise
    assert (steep.range_sigma_m, steep.range_ppm) == (pytest.approx(0.0, abs=1e-9), pytest.approx(40.0))


@pytest.mark.parametrize(
    ("figures", "message"),
    [
        ({"range_precision_mm": [{**PRECISION, "kind": "accuracy"}]}, "range_precision_mm.0.kind.*'precision'"),
        ({"range_accuracy_mm": {"value": 5, "kind": "precision", "source": "test"}}, "range_accuracy_mm.kind.*'accuracy'"),
        ({"range_accuracy_mm": {"value": 5, "kind": "accuracy"}}, "range_accuracy_mm.source' is missing"),
        ({"range_precision_mm": [PRECISION, PRECISION]}, "two different at_m"),
        ({"divergence_mrd": 1}, "did you mean 'divergence_mrad'"),
        ({"divergence_mrad": {"value": 0.3, "level": "1/e2", "angel": "full", "source": "test"}}, "did you mean 'angle'"),
        ({"zenith_limits_deg": {"value": [30, 230], "source": "test"}}, "less than or equal to 180"),
    ],
)
def test_mistakes_in_a_preset_are_named(figures: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        preset(**figures)


@pytest.mark.parametrize("override", ["scanner=leica_p40", "scanner.preset=leica_p40"])
def test_a_preset_fills_scanner_and_model(bare: Path, override: str) -> None:
    config = load_config(bare, [override], "tls", None)
    expected = read_preset("leica_p40")
    assert config.scanner == expected.scanner()
    assert config.scanner.name == "Leica ScanStation P40"
    assert config.scanner.zenith_limits_rad == (0.0, pytest.approx(np.radians(145)))
    assert config.tls_model() == expected.model()


def test_keys_beside_the_preset_go_before_it(bare: Path) -> None:
    bare.write_text("scanner: {preset: riegl_vz400i, azimuth_step_rad: 0.0003, pulse_rate_hz: 300000}\n")
    scanner = load_config(bare, [], "tls", None).scanner
    assert (scanner.azimuth_step_rad, scanner.pulse_rate_hz) == (0.0003, 300_000)
    assert scanner.zenith_limits_rad == pytest.approx(np.radians([30, 130]))
    assert scanner.zenith_step_rad == ScannerConfig().zenith_step_rad


def test_keys_stand_beside_a_bare_name_too(bare: Path) -> None:
    for text, overrides in (("epochs: 1", ["scanner=leica_p40"]), ("scanner: leica_p40", [])):
        bare.write_text(text + "\n")
        config = load_config(bare, [*overrides, "scanner.azimuth_step_rad=0.001"], "tls", None)
        assert config.scanner == read_preset("leica_p40").scanner().model_copy(update={"azimuth_step_rad": 0.001})


WRITTEN_OUT = """
scanner: {name: null, zenith_limits_rad: [0.5, 2.3], azimuth_step_rad: 0.0003, pulse_rate_hz: 100000.0, faces: 2}
sensor:
  - {sensor: stereo, noise: {parallax_sigma_px: 0.7}}
  - {sensor: tls, noise: {range_sigma_m: 0.007, angle_sigma_rad: 1.0e-3}, effects: [{name: range_offset, offset_m: 0.02}]}
"""
"""A file with keys of the instrument in it, such as the resolved config of a run."""


@pytest.mark.parametrize("name", ["riegl_vz400i", "leica_p50"])
@pytest.mark.parametrize(
    "override", ["scanner={}", "scanner.preset={}", "scanner={{preset: {}, azimuth_step_rad: 0.0003, faces: 2}}"]
)
def test_a_preset_named_later_wins_over_the_files_keys(bare: Path, override: str, name: str) -> None:
    """It also replaces the noise model; what the preset does not define stays: the pattern, the faces, the other sensor."""
    bare.write_text(WRITTEN_OUT)
    config, preset = load_config(bare, [override.format(name)], "tls", None), read_preset(name)
    assert preset.scanner_values().items() <= config.scanner.model_dump().items()
    assert (config.scanner.azimuth_step_rad, config.scanner.faces) == (0.0003, 2)
    assert config.tls_model() == preset.model()
    assert config.stereo_model().noise.parallax_sigma_px == 0.7


@pytest.mark.parametrize("order", [1, -1])
def test_keys_on_the_same_command_line_refine_the_preset(bare: Path, order: int) -> None:
    bare.write_text(WRITTEN_OUT)
    overrides = ["scanner.preset=riegl_vz400i", "scanner.pulse_rate_hz=300000", "sensor.1.noise.range_sigma_m=0.004"]
    config, preset = load_config(bare, overrides[::order], "tls", None), read_preset("riegl_vz400i")
    assert (config.scanner.name, config.scanner.pulse_rate_hz) == (preset.name, 300_000)
    assert config.tls_model().noise == preset.model().noise.model_copy(update={"range_sigma_m": 0.004})
    assert config.tls_model().effects == preset.model().effects


def test_a_later_preset_replaces_an_earlier_one(bare: Path) -> None:
    bare.write_text("scanner: {preset: riegl_vz400i, pulse_rate_hz: 300000}\n")
    for overrides in (["scanner=zf_5016"], ["scanner=leica_p40", "scanner.preset=zf_5016"]):
        config, preset = load_config(bare, overrides, "tls", None), read_preset("zf_5016")
        assert (config.scanner, config.tls_model()) == (preset.scanner(), preset.model())


def test_a_model_named_on_the_command_line_stays_beside_the_preset(tmp_path: Path, bare: Path) -> None:
    """Also if the config itself is a bare model, which is completed by the demo's values."""
    model = tmp_path / "model.yaml"
    model.write_text("sensor: tls\nnoise: {range_sigma_m: 0.007}\n")
    bare.write_text(WRITTEN_OUT)
    for path, overrides in ((bare, [f"sensor={model}"]), (model, [])):
        config = load_config(path, ["scanner.preset=zf_5016", *overrides], "tls", None)
        assert (config.scanner.name, config.tls_model().noise.range_sigma_m) == ("Z+F IMAGER 5016", 0.007)


def test_a_preset_replaces_a_model_that_the_file_names(tmp_path: Path, bare: Path) -> None:
    (tmp_path / "model.yaml").write_text("sensor: tls\nnoise: {range_sigma_m: 0.007}\n")
    bare.write_text("sensor: model.yaml\n")
    assert load_config(bare, ["scanner=zf_5016"], "tls", None).tls_model() == read_preset("zf_5016").model()


def test_a_model_of_ones_own_stays(bare: Path) -> None:
    bare.write_text("scanner: leica_p40\nsensor: {sensor: tls, noise: {range_sigma_m: 0.007}}\n")
    assert load_config(bare, [], "tls", None).tls_model().noise.range_sigma_m == 0.007


def test_a_stereo_model_stays_beside_the_presets_model(bare: Path) -> None:
    bare.write_text("scanner: leica_p40\nsensor: {sensor: stereo, noise: {parallax_sigma_px: 0.7}}\n")
    for sensor in ("stereo", "tls"):
        config = load_config(bare, [], sensor, None)
        assert config.stereo_model().noise.parallax_sigma_px == 0.7
        assert config.tls_model() == read_preset("leica_p40").model()


def test_a_preset_does_not_stop_the_other_sensor(bare: Path) -> None:
    load_config(bare, ["scanner=leica_p40"], "stereo", None)


def test_the_resolved_config_needs_the_preset_no_more(bare: Path) -> None:
    config = load_config(bare, ["scanner=zf_5016"], "tls", None)
    assert parse(SimulationConfig, config.model_dump(mode="json"), "run.json") == config


def test_a_scanner_of_ones_own_is_a_file_away(tmp_path: Path, bare: Path) -> None:
    (tmp_path / "mine.yaml").write_text("name: mine\npulse_rate_hz: {value: 5000, source: measured}\n")
    for text in ("scanner: mine.yaml", "scanner: {preset: mine.yaml}"):
        bare.write_text(text + "\n")
        assert load_config(bare, [], "tls", None).scanner.pulse_rate_hz == 5000


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("scanner=riegl_vz40i", "no bundled config 'riegl_vz40i'.*did you mean 'riegl_vz400i'"),
        ("scanner=nowhere.yaml", "nowhere.yaml: the file cannot be read"),
        ("scanner={preset: leica_p40, azimuth_stp_rad: 0.1}", "did you mean 'azimuth_step_rad'"),
        ("scanner=7", "'scanner'"),
        ('scanner="a\\0/b"', "null character"),
        ('sensor="a\\0/b"', "null character"),
    ],
)
def test_mistakes_in_naming_a_scanner_are_one_line(override: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_config(DEMO, [override], "tls", None)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "locks"), [("sgbm", True), ("sgbm_refined", False)])
def test_the_fitted_matchers_are_sensor_models_with_heavy_tails(name: str, locks: bool) -> None:
    model = load_config(configs_folder() / "demo.yaml", [f"sensor={name}"], "stereo", None).stereo_model()
    effects = {effect.name for effect in model.effects if not effect.is_null}
    assert effects == {"smoothing", "heavy_tailed_noise"} | ({"pixel_locking"} if locks else set())


def test_a_bundled_config_is_found_by_its_name_and_by_its_path_in_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bundled = configs_folder() / "sites" / "glendale.yaml"
    assert config_path("sites", Path("glendale")) == bundled
    assert config_path("sites", Path("configs/sites/glendale.yaml")) == bundled
    assert config_path("datasets", Path("small")) == configs_folder() / "datasets" / "small.yaml"
    Path("glendale").write_text("seed: 1\n")  # one's own goes before
    for own in ("glendale", "mine.yaml", "configs/sites/none.yaml", "folder/glendale"):
        assert config_path("sites", Path(own)) == Path(own)
    with pytest.raises(InputError, match=r"glendal: this is no file, and no bundled .* did you mean 'glendale'"):
        config_path("sites", Path("glendal"))

"""Every command of README.md and docs/ does what its page says: it is run on a small scene, or resolved without being run.

A command that is in none of the lists here fails `test_every_command_is_in_a_list`. test_docs.py runs the commands of how-to
guides and tutorials, and test_mistakes.py those of docs/reference/mistakes.md.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import howtos
import pytest
import yaml
from docs_commands import PAGES, ROOT, check_overrides, commands, flags_of, holds, known_flags, parsed, resolved

from pipeline.cli.main import COMMANDS, main, simulate
from pipeline.config.bundled import configs_folder
from pipeline.config.presets import read_preset
from pipeline.config.simulation import load_config
from pipeline.formats.cameras.metashape import write_metashape
from pipeline.formats.meshes.ply import write_ply
from pipeline.view.server import open_results
from scene.common.keyed_random import KeyedRandom
from scene.walls.procedural import ProceduralWall
from sensors.models.placement import RigConfig, Target

TINY = [
    *("--set", "scanner.azimuth_step_rad=0.002", "--set", "scanner.zenith_step_rad=0.002"),
    *("--set", "difference.gsd_m=0.1", "--set", "rockfall.count=2", "--quiet"),
]
TINY_WALL = ["--set", "wall.width_m=6", "--set", "wall.height_m=4", "--set", "wall.resolution_m=0.2"]
FAR = "reconstruction=vertices,noisy_reference=false,scanner.azimuth_step_rad=0.00038,scanner.zenith_step_rad=0.00038"
NEAR = FAR.replace("0.00038", "0.0007")
DIRECT = "reconstruction=direct,depth_map=high,noisy_reference=false"
INIT = "scarpsim init --mesh wall.ply --cameras cameras.xml --scanner riegl_vz400i --out site.yaml"
FIRST = "simulate --sensor tls --config site.yaml"
MY_SITE = "scarpsim init --site glendale --scanner riegl_vz400i --out my_site.yaml"
MY_SET = "scarpsim init --dataset small"
PLAN = "scarpsim inspect configs/sites/glendale.yaml --out plan"
SCRIPT = "simulate --sensor tls --json --quiet"
COMPLETION = "scarpsim completion bash"
VIEW = "scarpsim view runs/my_run"
TRIED_ELSEWHERE = ("mistakes.md", "checks.md")
"""Pages whose commands test_mistakes.py and test_checks.py carry out."""
RUN = (INIT, MY_SITE, MY_SET, PLAN, SCRIPT, COMPLETION, VIEW)
"""Carried out by the tests of their own below."""

RESOLVED = (
    "simulate --sensor stereo --set matcher=sgbm",
    "simulate --sensor tls --config runs/mine/run.json",
    "simulate --sensor tls --set scanner=my_scanner.yaml",
    "simulate --sensor stereo --config configs/sites/glendale.yaml --set sensor=glendale_high --set reconstruction=vertices "
    "--set noisy_reference=false",
    "simulate --sensor stereo --config my_site.yaml --set sensor=calibration/calibrated.yaml",
    "scarpsim inspect glendale",
    "scarpsim inspect configs/sites/glendale.yaml --set station.distance_m=100 --set cameras.distance_m=100 --out plans/100m",
    "scarpsim inspect configs/sites/glendale.yaml --sensor tls --set scanner=riegl_vz400i --json",
    "scarpsim compare my_site.yaml riegl_vz400i",
    "scarpsim compare configs/demo.yaml riegl_vz400i --own-step --epochs 8 --sizes-m 0.04 0.6",
    "scarpsim compare pilkington leica_p50 --epochs 4 --sizes-m 0.02 0.3 --out road",
    "scarpsim compare glendale riegl_vz400i --set wall.width_m=35 --set wall.height_m=22 --epochs 4 "
    "--sizes-m 0.05 0.6 --out cliff",
    "scarpsim compare glendale riegl_vz2000i --set wall.width_m=60 --set wall.height_m=40 --set wall.resolution_m=0.1 "
    "--set cameras.distance_m=400 --set cameras.base_m=100 --set cameras.focal_length_m=0.2 --set station.distance_m=400 "
    "--set difference.gsd_m=0.05 --epochs 4 --sizes-m 0.1 1.5 --out far",
    "scarpsim calibrate maps/*.tif --sensor stereo --config my_site.yaml --out calibration",
    "scarpsim calibrate maps --config configs/sites/glendale.yaml --sensor stereo --set sensor=glendale_independent_low "
    "--set difference.gsd_m=0.04 --set calibration.window_px=32 --set calibration.simulations=100",
    "scarpsim icp-study configs/demo.yaml --sensor stereo --set sensor=glendale_independent_high --set cameras.distance_m=105 "
    "--set cameras.base_m=28",
    "scarpsim gap --identifiability configs/sites/glendale.yaml --sensor tls --out plan",
    "scarpsim dataset configs/datasets/small.yaml --out sets/small --workers 2",
    "scarpsim dataset configs/datasets/detector.yaml --out sets/one",
    "scarpsim dataset configs/datasets/detector.yaml --seed 13 --set parts.0.val=0 --set name=detector2 --out sets/two",
    "scarpsim dataset configs/datasets/detector_test.yaml --out sets/detector_test",
    'scarpsim dataset configs/datasets/detector_test.yaml --set "sensors=[tls]" --set "parts.0.sizes=[large]" '
    "--set tiles.size_px=1560 --set tiles.minimum_valid_share=0.05 --set name=whole --out sets/whole",
    "scarpsim dataset configs/datasets/detector_test.yaml --set tiles.size_px=1560 --set tiles.minimum_valid_share=0.05 "
    '--set name=whole --set "parts.0.walls=[glendale-b,bismantova]" --set parts.0.test=1 --out sets/whole_two',
    'scarpsim dataset configs/datasets/detector_test.yaml --set "sensors=[tls]" --set "parts.0.sizes=[large]" '
    "--set tiles.size_px=1560 --set tiles.minimum_valid_share=0.05 --set name=whole-mean --set parts.0.test=1 "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/whole_mean",
    "scarpsim train sets/small --out detector",
    "scarpsim train sets/small --config configs/detectors/fine.yaml --out detector",
    "scarpsim train sets/detector --config configs/detectors/fine.yaml --set training.epochs=24 --out detector",
    "scarpsim dataset configs/datasets/detector.yaml --seed 14 --set parts.0.val=0 --set name=detector3 "
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/three",
    'scarpsim dataset configs/datasets/detector.yaml --seed 15 --set parts.0.train=0 --set "parts.0.walls=[glendale,near]" '
    '--set "parts.0.noise=[2.5cm,7.5cm]" --set name=detector4 '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/four",
    "scarpsim dataset configs/datasets/detector_test.yaml --out sets/detector_test_mean --set name=detector-test-mean-surface "
    "--set parts.0.test=1 "
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface",
    "scarpsim train sets/mixed --config configs/detectors/fine.yaml --set training.start=detector/best "
    "--set training.learning_rate=0.001 --set training.epochs=20 --set training.keep_epochs=10 --out further",
    "scarpsim train sets/mixed --config configs/detectors/fine.yaml --seed 3 --set training.start=further/best "
    "--set training.learning_rate=0.001 --set training.epochs=20 --set training.keep_epochs=10 "
    "--set training.precision=bfloat16 --out more",
    "scarpsim train sets/mixed --config configs/detectors/fine.yaml --seed 4 --set training.start=more/best "
    "--set training.learning_rate=0.001 --set training.epochs=27 --set training.precision=bfloat16 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --set detector.head.mirrored=both --out still_more',
    "scarpsim dataset configs/datasets/detector.yaml --set parts.0.train=0 --out sets/one_val",
    "scarpsim dataset configs/datasets/detector.yaml --seed 16 --set parts.0.val=0 "
    '--set "parts.0.noise=[2.5cm,7.5cm]" --set name=detector5 --out sets/five',
    "scarpsim dataset configs/datasets/detector.yaml --seed 17 --set parts.0.val=0 "
    '--set "parts.0.noise=[2.5cm,5cm]" --set name=detector6 '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/six",
    "scarpsim dataset configs/datasets/detector.yaml --seed 18 --set parts.0.val=0 "
    '--set "parts.0.noise=[8mm,5cm]" --set name=detector7 --out sets/seven',
    "scarpsim train sets/further --config configs/detectors/fine.yaml --seed 5 --set training.start=still_more/best "
    "--set training.learning_rate=0.0005 --set training.epochs=40 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --set detector.head.mirrored=both --out further_still',
    "scarpsim dataset configs/datasets/detector.yaml --seed 19 --set parts.0.val=0 --set name=detector8 "
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=21,{FAR}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=22,{FAR}]" '
    f'--set "walls.near.set=[wall.style=glendale,wall.seed=23,{NEAR}]" --out sets/eight',
    "scarpsim dataset configs/datasets/detector.yaml --seed 20 --set parts.0.val=0 --set name=detector9 "
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=24,{FAR}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=25,{FAR}]" '
    f'--set "walls.near.set=[wall.style=bulga,wall.seed=26,{NEAR}]" '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/nine",
    "scarpsim train sets/other_rock --config configs/detectors/fine.yaml --seed 6 --set training.start=further_still/best "
    "--set training.learning_rate=0.0005 --set training.epochs=6 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --set detector.head.mirrored=both --out other_rock',
    "scarpsim dataset configs/datasets/detector.yaml --seed 21 --set parts.0.val=0 --set name=detector_ten "
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=31,{FAR}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=32,{FAR}]" '
    f'--set "walls.near.set=[wall.style=bulga,wall.seed=33,{NEAR}]" '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/ten",
    "scarpsim dataset configs/datasets/detector.yaml --seed 22 --set parts.0.val=0 --set name=detector_eleven "
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=34,{FAR}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=35,{FAR}]" '
    f'--set "walls.near.set=[wall.style=glendale,wall.seed=36,{NEAR}]" --out sets/eleven',
    "scarpsim dataset configs/datasets/detector.yaml --seed 23 --set parts.0.val=0 --set name=detector_twelve "
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=37,{FAR}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=38,{FAR}]" '
    f'--set "walls.near.set=[wall.style=glendale,wall.seed=39,{NEAR}]" '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/twelve",
    "scarpsim dataset configs/datasets/detector.yaml --seed 24 --set parts.0.val=0 --set name=detector_thirteen "
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=40,{FAR}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=41,{FAR}]" '
    f'--set "walls.near.set=[wall.style=bulga,wall.seed=42,{NEAR}]" --out sets/thirteen',
    "scarpsim train sets/more_rock --config configs/detectors/fine.yaml --set training.start=other_rock/best "
    "--set training.data=resident --set training.batch=64 --set training.learning_rate=0.002 "
    "--set training.warm_up_steps=500 --set training.epochs=169 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --set detector.head.mirrored=both --out on_a_card',
    'scarpsim dataset configs/datasets/detector.yaml --seed 25 --set name=detector_fourteen --set "sensors=[stereo]" '
    f'--set "walls.glendale.set=[wall.height_m=30,wall.seed=43,{DIRECT}]" '
    f'--set "walls.bulga.set=[wall.height_m=30,wall.seed=44,{DIRECT}]" '
    f'--set "walls.near.set=[wall.style=glendale,wall.seed=45,{DIRECT}]" '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/fourteen",
    "scarpsim train sets/both --config configs/detectors/fine.yaml --seed 8 --set training.start=on_a_card/best "
    "--set training.learning_rate=0.0005 --set training.epochs=10 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --set detector.head.mirrored=both --out both',
    "scarpsim dataset configs/datasets/detector_test.yaml --set name=detector-test-direct "
    '--set "sensors=[stereo]" --set "parts.0.walls=[glendale-b,bulga-b]" --set parts.0.test=1 '
    f'--set "walls.glendale-b.set=[wall.seed=8,wall.width_m=31,wall.height_m=21,{DIRECT}]" '
    f'--set "walls.bulga-b.set=[wall.seed=8,wall.width_m=31,wall.height_m=21,{DIRECT}]" '
    "--set sizes.small.rockfall.placement=mean_surface --set sizes.medium.rockfall.placement=mean_surface "
    "--set sizes.large.rockfall.placement=mean_surface --out sets/direct",
    "scarpsim train sets/small --config configs/detectors/fine.yaml --set training.data=resident --set training.batch=64 "
    "--out detector",
    "scarpsim train sets/more_rock --config configs/detectors/fine.yaml --set training.data=resident "
    "--set detector.pyramid_channels=64 --set detector.head.hidden_units=256 --set training.batch=64 "
    "--set training.learning_rate=0.003 --set training.warm_up_steps=500 --set training.epochs=153 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --out wide',
    "scarpsim train sets/more_rock --config configs/detectors/fine.yaml --set training.data=resident "
    "--set detector.backbone=resnet50 --set detector.pyramid_channels=256 --set detector.head.hidden_units=1024 "
    '--set "detector.proposal.anchor_sizes_px=[6,14,32,64,128]" --set detector.proposal.convolution_px=3 '
    "--set training.batch=32 --set training.learning_rate=0.0005 --set training.warm_up_steps=300 --set training.epochs=17 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --out resnet',
    "scarpsim train sets/both --config configs/detectors/fine.yaml --set training.start=default "
    "--set training.learning_rate=0.0005 "
    '--set "training.loss_weights={proposal_box: 0.2, box: 0.5}" --set detector.head.mirrored=both --out more_yet',
)
"""Take minutes, or work on results: their words are parsed, their configs read, and each --set must be seen in the config."""

PARSED = (
    "simulate --sensor tls --config series.yaml --out runs/series",
    "scarpsim export runs/series epochs --out series.gif",
    "scarpsim inspect series.yaml --series --sensor tls --out plan",
    "scarpsim monitor runs/series --out found",
    "scarpsim view runs/my_series",
    "scarpsim view runs/series",
    "scarpsim view april",
    "scarpsim view june",
    "scarpsim monitor march.laz april.laz --out april",
    "scarpsim gap april --out april_gap",
    "scarpsim calibrate april_gap/measurement --out april_calibration",
    "scarpsim monitor scans/2026-*.laz --workers 2 --out year",
    "scarpsim monitor scans/2026-*.laz --workers 2 --out year --resume",
    "scarpsim monitor reference.laz --follow incoming --out live",
    "scarpsim calibrate my_measurement --out calibration",
    "scarpsim dataset verify sets/small",
    "scarpsim dataset verify sets/small --report-only",
    "scarpsim dataset merge sets/a sets/b --out sets/ab",
    "scarpsim dataset merge sets/one sets/two --out sets/detector",
    "scarpsim dataset merge sets/one sets/three sets/four --out sets/mixed",
    "scarpsim dataset merge sets/one_val sets/four sets/six sets/five sets/seven --out sets/further",
    "scarpsim dataset merge sets/one_val sets/four sets/eight sets/nine --out sets/other_rock",
    "scarpsim dataset merge sets/one_val sets/four sets/eight sets/nine sets/ten sets/eleven sets/twelve sets/thirteen "
    "--out sets/more_rock",
    "scarpsim dataset merge sets/fourteen sets/four sets/twelve_by/tls sets/thirteen_by/stereo --out sets/both",
    "scarpsim dataset split sets/ab --by sensor,noise,size --out sets/parts",
    "scarpsim dataset split sets/twelve --by sensor --out sets/twelve_by",
    "scarpsim dataset split sets/thirteen --by sensor --out sets/thirteen_by",
    "scarpsim detect detector/best runs/bulga --out found",
    "scarpsim detect default runs/bulga --out found",
    "scarpsim detect default runs/bulga --mirrored",
    "scarpsim detect default sets/direct/test --mirrored --out found",
    "scarpsim evaluate sets/direct/test found/detections.json --by size_class --confidence 0.95",
    "scarpsim detect baseline runs/bulga --out found_by_threshold",
    "scarpsim evaluate sets/small/test found/detections.json --by noise --confidence 0.5 --confidence 0.95",
    "scarpsim view runs/my_run --detections found",
    "scarpsim gap scan.e57 --reference wall.ply --scanner leica_p50",
    "scarpsim gap my_measurement --set mean.class_margin=4 --set points.fewest=500 --out diagnosis",
    "scarpsim gap scan.laz --reference wall.ply --scanner riegl_vz400i --out diagnosis",
    "scarpsim gap cloud.ply --reference wall.ply --photographs --out diagnosis",
    "scarpsim view diagnosis",
    "scarpsim view finding",
    "scarpsim view runs/scanner runs/pair",
    "scarpsim view runs/stereo runs/tls",
    "scarpsim view sets/small/test",
    "scarpsim doctor",
    "scarpsim export runs/my_run picture --epoch 1 --out wall.png",
    "scarpsim export runs/my_run epochs --out epochs.gif",
    "scarpsim export runs/my_run scan --out scan.gif",
    "scarpsim export runs/my_run gltf --out wall.glb",
    "scarpsim export runs/my_run copc --out wall.copc.laz",
    "scarpsim export sets/small yolo --out sets/small_yolo",
    "scarpsim export sets/small huggingface --out sets/small_hf",
    "scarpsim export runs/my_run package",
)
"""Work on results alone: their words are parsed."""

NAMED = (
    "scarpsim monitor",
    "scarpsim --help",
    "scarpsim COMMAND --help",
    "scarpsim schema KIND",
    "scarpsim completion --help",
    "scarpsim simulate",
    "scarpsim calibrate",
    "scarpsim compare",
    "scarpsim compare CONFIG [CONFIG ...] [--measured FOLDER ...] [--epochs N] [--sizes-m FIRST LAST | --blocks config] "
    "[--own-step]",
    "scarpsim detect",
    "scarpsim evaluate",
    "scarpsim export",
    "scarpsim gap",
    "scarpsim gap --identifiability",
    "scarpsim gap --identifiability CONFIG",
    "scarpsim init --mesh wall.ply --cameras cameras.xml --out my_site.yaml",
    "scarpsim icp-study RUN|CONFIG [--sensor stereo|tls] [--epochs N] [--offset-m 0.03] --out DIR",
    "scarpsim inspect",
    "scarpsim inspect --series",
    "scarpsim inspect my_site.yaml",
    "scarpsim dataset",
    "scarpsim surface",
    "scarpsim surface scan.laz --seen-from X Y Z --out wall.ply",
    "scarpsim view",
)
"""Not to be typed as they stand: the command and its flags must be there."""

OF_A_STYLE_TO_COME = ("simulate --sensor tls --set wall.style=my_style --set rockfall.count=10 --out runs/my_style",)
"""With a style that the page tells how to write."""

OF_A_PACKAGE_TO_COME = (
    "simulate --sensor tls --set scanner=my_scanner --set wall.style=quarry",
    "scarpsim compare my_site.yaml my_scanner",
)
"""With a package that the page tells how to write; tests/test_plug_ins.py installs one."""


def carry_out(command: str, *further: str) -> str:
    """Run a command with further arguments; return what it prints."""
    program, *words = shlex.split(command)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = {"scarpsim": main, "simulate": simulate}[program]([*words, *further])
    assert code == 0, command
    return printed.getvalue()


@pytest.fixture(scope="module", autouse=True)
def playground(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The working folder: README's first commands have been run in it, and it contains the other files that the pages name."""
    before, folder = Path.cwd(), tmp_path_factory.mktemp("docs")
    os.chdir(folder)
    try:
        wall = ProceduralWall(width_m=6.0, height_m=4.0, resolution_m=0.2).mesh(KeyedRandom(1))
        write_ply(Path("wall.ply"), wall)
        pair = RigConfig(distance_m=30.0, base_m=8.0).place(Target(wall))
        write_metashape(Path("cameras.xml"), {"left": pair.left, "right": pair.right})
        carry_out(INIT)
        carry_out(FIRST, *TINY, "--out", "runs/my_run")
        carry_out(MY_SITE)
        shutil.copytree("runs/my_run", "runs/mine")
        for name, model in MODELS.items():
            Path(name).parent.mkdir()
            Path(name).write_text(yaml.safe_dump(model))
        (text,) = re.findall(r"```yaml\n(name: My scanner.*?)```", (ROOT / "docs/howto/add_sensor.md").read_text(), re.DOTALL)
        Path("my_scanner.yaml").write_text(text)
        yield folder
    finally:
        os.chdir(before)


MODELS: dict[str, Any] = {
    "gap/model_after.yaml": {"sensor": "tls", "effects": [{"name": "range_offset", "offset_m": 0.004}]},
    "calibration/calibrated.yaml": {"sensor": "stereo", "noise": {"parallax_sigma_px": 0.37}},
}
"""Stand for what `scarpsim gap` and `scarpsim calibrate` write."""


def test_every_command_is_in_a_list() -> None:
    """Also, no list has a command twice or one that no page shows any more."""
    listed = [*RUN, *RESOLVED, *PARSED, *NAMED, *OF_A_STYLE_TO_COME, *OF_A_PACKAGE_TO_COME]
    assert len(set(listed)) == len(listed)
    carried_out = {
        line
        for page in (*howtos.PICTURES, *howtos.TUTORIALS)
        for step in howtos.steps(page)
        if not step.file
        for line in step.text.splitlines()
    }
    shown = {command for page in PAGES if page.name not in TRIED_ELSEWHERE for command in commands(page)}
    assert shown - carried_out - set(listed) == set(), "put these into one of the lists, at best RUN"
    assert set(listed) - shown == set(), "no page shows these"
    assert carried_out <= shown, "commands are not found"


def test_commands_are_found_in_all_their_forms(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    indented, fenced = "    simulate --sensor tls | jq '.a'  # so", "```bash\nscarpsim doctor\n```"
    page.write_text(f"See `scarpsim\ngap X`, `simulated`, `scarpsim`.\n\n{indented}\n\n{fenced}\n")
    assert commands(page) == ["scarpsim doctor", "simulate --sensor tls", "scarpsim gap X"]


def test_init_writes_the_demo_s_config_with_the_files_of_one_s_own() -> None:
    assert main(["init", "--out", "demo.yaml", "--quiet"]) == 0
    demo, own = (load_config(path, [], None, None) for path in (configs_folder() / "demo.yaml", Path("site.yaml")))
    assert load_config(Path("demo.yaml"), [], None, None) == demo
    changed = {name for name in type(own).model_fields if getattr(own, name) != getattr(demo, name)}
    assert changed == {"wall", "cameras", "scanner", "sensor"}


def test_the_first_simulation_is_of_the_mesh_and_the_scanner_that_were_asked_for() -> None:
    """The RIEGL VZ-400i: 1.2 MHz, 30 to 130 degrees in zenith, 3 mm, 0.35 mrad at 1/e2."""
    run = json.loads(Path("runs/my_run/run.json").read_text())
    scanner, (model,) = run["config"]["scanner"], [each for each in run["config"]["sensor"] if each["sensor"] == "tls"]
    assert run["sensor"] == "tls"
    assert run["wall"]["name"] == "wall"
    assert (scanner["name"], scanner["pulse_rate_hz"]) == ("RIEGL VZ-400i", 1.2e6)
    assert scanner["zenith_limits_rad"] == pytest.approx([0.5235988, 2.2689280])
    assert model["noise"]["range_sigma_m"] == 0.003
    assert [(effect["name"], effect["divergence_rad"]) for effect in model["effects"]] == [
        ("beam_divergence", pytest.approx(0.35e-3))
    ]
    report = Path("runs/my_run/report.html").read_text()
    for words in ("RIEGL VZ-400i; 1200 kHz", "range 3 mm", "beam_divergence (divergence_rad 0.00035)", "Distance to the wall"):
        assert words in report


def test_the_run_folder_holds_what_its_page_says() -> None:
    """The files of a laser scanner's run, by docs/reference/formats/run_folder.md."""
    for name in ("difference_001.tif", "annotations.json", "report.html"):
        assert (Path("runs/my_run") / name).stat().st_size > 0
    for name in ("points.laz", "surface.ply", "truth.ply", "blocks.json"):
        assert (Path("runs/my_run/epoch_001") / name).stat().st_size > 0


def test_init_with_a_site_and_a_scanner() -> None:
    config, site = (
        load_config(path, [], None, None) for path in (Path("my_site.yaml"), configs_folder() / "sites/glendale.yaml")
    )
    preset = read_preset("riegl_vz400i")
    assert (config.wall, config.rockfall, config.station) == (site.wall, site.rockfall, site.station)
    assert (config.scanner.name, config.tls_model()) == (preset.name, preset.model())
    assert Path("scarpsim.simulation.schema.json").is_file()


def test_init_with_a_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    carry_out(MY_SET)
    assert Path("scarpsim.yaml").read_text().endswith((configs_folder() / "datasets/small.yaml").read_text())


def test_the_plan_has_the_maps_that_the_readme_promises() -> None:
    """Maps of precision, spacing, blind spots and the smallest block, here for the scanner; a how-to inspects both sensors."""
    carry_out(PLAN, *TINY_WALL, "--sensor", "tls", "--set", "planning.gsd_m=0.5", "--quiet")
    maps = {path.stem for path in Path("plan").glob("*.tif")}
    assert {"tls_normal_sigma_m", "tls_spacing_line_m", "tls_views", "tls_smallest_block_m"} <= maps
    assert Path("plan/report.html").is_file()


def test_a_script_finds_the_value_that_the_page_asks_jq_for() -> None:
    (path,) = re.findall(r"\| jq '\.([^']+)'", (ROOT / "docs/reference/command_line.md").read_text())
    value = json.loads(carry_out(SCRIPT, *TINY, *TINY_WALL, "--out", "runs/script"))
    for key, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        value = value[key] if not index else value[key][int(index)]
    assert 0.0005 < value < 0.05, "the NMAD of the differences, m"


def test_the_completion_knows_the_commands() -> None:
    script = carry_out(COMPLETION)
    assert "icp-study" in script
    assert "--sensor" in script


def test_the_viewer_opens_the_run() -> None:
    _, given = parsed(VIEW)
    assert open_results(given.folder).steps == {"1": "epoch 1"}


@pytest.mark.parametrize("command", RESOLVED)
def test_a_command_resolves_to_what_it_asks_for(command: str) -> None:
    assert list(resolved(command)), "nothing to look at: this one is only parsed"
    check_overrides(command)
    CLAIMS.get(command, lambda: None)()


@pytest.mark.parametrize("command", PARSED)
def test_a_command_is_parsed(command: str) -> None:
    parsed(command)


@pytest.mark.parametrize("command", NAMED)
def test_a_command_that_is_named_is_there(command: str) -> None:
    name = command.split()[1]
    if name not in ("--help", "COMMAND"):
        assert name in COMMANDS
        assert flags_of(command) <= known_flags(name) | {"--help"}


@pytest.mark.parametrize("command", OF_A_STYLE_TO_COME)
def test_a_command_for_a_style_to_come_works_with_one_that_is_there(command: str) -> None:
    check_overrides(command.replace("my_style", "bulga"))


def the_effect_arrives() -> None:
    (config,) = resolved("simulate --sensor tls --config gap/model_after.yaml")
    (model,) = config["sensor"]
    assert holds(model["effects"], [{"name": "range_offset", "offset_m": 0.004}])


def the_run_is_the_same() -> None:
    (config,) = resolved("simulate --sensor tls --config runs/mine/run.json")
    assert config == json.loads(Path("runs/my_run/run.json").read_text())["config"]


def the_scanner_is_compared() -> None:
    names = [config["scanner"]["name"] for config in resolved("scarpsim compare configs/demo.yaml riegl_vz400i")]
    assert names[-1] == "RIEGL VZ-400i"
    assert len(names) == 3, "both sensors of the demo, and the scanner"


CLAIMS: dict[str, Callable[[], None]] = {
    "simulate --sensor tls --config gap/model_after.yaml": the_effect_arrives,
    "simulate --sensor tls --config runs/mine/run.json": the_run_is_the_same,
    "scarpsim compare configs/demo.yaml riegl_vz400i --own-step --epochs 8 --sizes-m 0.04 0.6": the_scanner_is_compared,
}
"""What a page says of a command beyond its --set."""

"""The page of configs: every key of a simulation's config, as `scarpsim init` writes it."""

from __future__ import annotations

from pipeline.config.bundled import bundled_config
from pipeline.config.commented import commented_yaml
from pipeline.config.simulation import SimulationConfig
from scene.common.config import load_yaml, parse

_TEXT = """# Configuration

A config is short, because everything has a default. Keys carry their units; a key that does not exist is an error with a
suggestion. `--set a.b=value` overrides any of them on the command line, `--set sensor=glendale_high` and `--set
scanner=riegl_vz400i` put in a bundled noise model or [scanner](scanners/index.md). Of a scanner's preset and a key that stand
together, in one file or on one command line, the key wins; a preset on the command line wins over the file's keys that it
sets, its noise and beam over the file's model. Paths in a config are relative to its folder.

Below are all keys with their meaning, unit and bounds, as `scarpsim init` writes them for the demo: those that it sets, and after
`#` all others with their defaults.

```yaml
{config}
```
"""


def pages() -> dict[str, str]:
    """One page."""
    source = bundled_config("", "demo")
    values = load_yaml(source)
    text = commented_yaml(parse(SimulationConfig, values, str(source)), values)
    return {"reference/configuration.md": _TEXT.format(config=text.strip())}

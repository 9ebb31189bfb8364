"""The page of configs: every key of a simulation's config, as `scarpsim init` writes it."""

from __future__ import annotations

from pipeline.bundled import bundled_config
from pipeline.commented import commented_yaml
from pipeline.config import SimulationConfig
from scene.config import load_yaml, parse

_TEXT = """# Configuration

A config is short, because everything has a default. Keys carry their units; a key that does not exist is an error with a
suggestion. `--set a.b=value` overrides any of them on the command line, `--set sensor=glendale_high` and `--set
scanner=riegl_vz400i` put in a bundled noise model or [scanner](../scanners/index.md). Paths in a config are relative to its
folder.

Below are all keys with their meaning, bounds and, where it differs, default, as `scarpsim init` writes them for the demo.

```yaml
{config}
```
"""


def pages() -> dict[str, str]:
    """One page."""
    source = bundled_config("", "demo")
    text = commented_yaml(parse(SimulationConfig, load_yaml(source) or {}, str(source)))
    return {"reference/configuration.md": _TEXT.format(config=text.strip())}

"""YAML as config files and `--set` use it: the core schema of YAML 1.2, safe, duplicate keys refused.

PyYAML follows YAML 1.1, which reads 1e-3 as text, 1:30 as 90, 010 as 8 and a date as an object; in a config each of these is a
silent mistake.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

_MAP, _NULL, _BOOL = "tag:yaml.org,2002:map", "tag:yaml.org,2002:null", "tag:yaml.org,2002:bool"
_INT, _FLOAT, _MERGE = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float", "tag:yaml.org,2002:merge"
_SCALARS = {
    _NULL: (r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    _BOOL: (r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    _INT: (r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", list("-+0123456789")),
    _FLOAT: (
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        list("-+.0123456789"),
    ),
    _MERGE: (r"^<<$", ["<"]),
}


_MOST_MERGED = 10_000
_LONGEST_NUMBER = 400


class _Loader(yaml.SafeLoader):
    """SafeLoader with the core schema's scalars."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012  (PyYAML's own name)

    def integer(self, node: yaml.ScalarNode) -> int:
        text = self.construct_scalar(node)
        if len(text) > _LONGEST_NUMBER:
            raise _wrong(node, f"a number of {len(text):,} digits")
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)

    def mapping(self, node: yaml.MappingNode) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise _wrong(key, f"the key '{key.value:.80}' stands there twice")
            seen.add(str(key.value))
        return self.construct_mapping(node, deep=True)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """As PyYAML does, which puts what `<<` names into the mapping: a few lines can ask for any number of keys."""
        super().flatten_mapping(node)
        if len(node.value) > _MOST_MERGED:
            raise _wrong(node, f"more than {_MOST_MERGED:,} keys in one mapping")


def _wrong(node: yaml.Node, problem: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


for _tag, (_pattern, _first) in _SCALARS.items():
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), _first)
_Loader.add_constructor(_INT, _Loader.integer)
_Loader.add_constructor(_MAP, _Loader.mapping)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes the texts which `_Loader` would read as something else."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: object) -> bool:
        return True


def parse_yaml(text: str) -> Any:
    """The value that `text` holds; raises yaml.YAMLError where it is malformed or asks for more than plain data."""
    try:
        return yaml.load(text, Loader=_Loader)
    except RecursionError:
        raise yaml.YAMLError("nested too deeply") from None


def yaml_line(value: Any) -> str:
    """Plain data as one line of YAML that `parse_yaml` reads back."""
    text = yaml.dump(value, Dumper=_Dumper, default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")

"""Parse and write YAML as config files and `--set` use it: the core schema of YAML 1.2, plain data only, no duplicate keys.

PyYAML follows YAML 1.1, which reads 1e-3 as text, 1:30 as 90, 010 as 8 and a date as an object. In a config each of these
would be a silent mistake.
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
"""Most keys in one mapping: with merge keys (`<<`) a few lines can ask for any number of them."""
_LONGEST_NUMBER = 400
"""Most digits of a whole number: converting a very long one takes long."""


class _Loader(yaml.SafeLoader):
    """PyYAML's SafeLoader with the scalars of YAML 1.2's core schema."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012  (PyYAML's own name)

    def integer(self, node: yaml.ScalarNode) -> int:
        """Convert a whole number: decimal, octal (0o17) or hexadecimal (0x1f)."""
        text = self.construct_scalar(node)
        if len(text) > _LONGEST_NUMBER:
            raise _wrong(node, f"a number of {len(text):,} digits")
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)

    def mapping(self, node: yaml.MappingNode) -> dict[Hashable, Any]:
        """Convert a mapping. Raises YAMLError if a key stands in it twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise _wrong(key, f"the key '{key.value:.80}' is given twice")
            seen.add(str(key.value))
        return self.construct_mapping(node, deep=True)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Insert what `<<` refers to, as PyYAML does, up to a limit on the number of keys."""
        super().flatten_mapping(node)
        if len(node.value) > _MOST_MERGED:
            raise _wrong(node, f"more than {_MOST_MERGED:,} keys in one mapping")


def _wrong(node: yaml.Node, problem: str) -> yaml.YAMLError:
    """Make an error that names the place in the text."""
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


for _tag, (_pattern, _first) in _SCALARS.items():
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), _first)
_Loader.add_constructor(_INT, _Loader.integer)
_Loader.add_constructor(_MAP, _Loader.mapping)


class _Dumper(yaml.SafeDumper):
    """PyYAML's SafeDumper, which quotes any text that `_Loader` would read as something other than text."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: object) -> bool:
        """Write repeated values in full instead of as aliases."""
        return True


def parse_yaml(text: str) -> Any:
    """Parse the text of a YAML file into plain data: dict, list, str, numbers, booleans and None.

    Raises yaml.YAMLError if the text is malformed or asks for other objects.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except RecursionError:
        raise yaml.YAMLError("nested too deeply") from None


def yaml_problem(error: yaml.YAMLError) -> str:
    """Describe an error of `parse_yaml` in one line, with the line and column of the text if they are known, both from 1."""
    problem, mark = getattr(error, "problem", None), getattr(error, "problem_mark", None)
    if problem is None or mark is None:
        return " ".join(str(error).split()).replace('in "<unicode string>", ', "at ")
    context = getattr(error, "context", None)
    return f"line {mark.line + 1}, column {mark.column + 1}: {problem}" + (f" ({context})" if context else "")


def yaml_line(value: Any) -> str:
    """Write plain data (dict, list, str, numbers, booleans, None) as one line of YAML, which `parse_yaml` reads back."""
    text = yaml.dump(value, Dumper=_Dumper, default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")

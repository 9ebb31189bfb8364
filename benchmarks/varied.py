"""A number that also carries its values under other settings, and records which setting would change a decision.

What is computed with the number is computed with each of its other values too, and comparisons likewise. As long as no comparison
differs and nothing else looks at the value, the same program with the other setting would do the same.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

Setting = tuple[str, Any]


class Varied:
    """A value, its values with other settings, and the set that records settings that make a difference."""

    def __init__(self, value: Any, others: dict[Setting, Any], matters: set[Setting]) -> None:
        self.value, self.others, self.matters = value, others, matters

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        function = getattr(ufunc, method)
        return _applied(lambda *values: function(*values, **options), inputs)

    def __getattr__(self, name: str) -> Any:
        """Refuse all other uses of the value, which cannot be followed."""
        if name.startswith("__array_"):
            raise AttributeError(name)
        return getattr(self._seen(), name)

    def _seen(self) -> Any:
        self.matters.update(self.others)
        return self.value

    def __array__(self, *arguments: Any, **options: Any) -> Any:
        return np.array(self._seen(), *arguments, **options)

    def __float__(self) -> float:
        return float(self._seen())

    def __int__(self) -> int:
        return int(self._seen())

    def __index__(self) -> int:
        return operator.index(self._seen())

    def __bool__(self) -> bool:
        return bool(_applied(bool, (self,)))

    def __hash__(self) -> int:
        return hash(self._seen())

    def __len__(self) -> int:
        return len(self._seen())

    def __iter__(self) -> Iterator[Any]:
        return iter(self._seen())

    def __getitem__(self, key: Any) -> Any:
        return _applied(lambda value: value[key], (self,))

    def __format__(self, how: str) -> str:
        return format(self._seen(), how)

    def __str__(self) -> str:
        return str(self._seen())


def _applied(function: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
    """Apply the function to the value and to its alternatives.

    If the function decides (true or false), those settings are recorded that decide otherwise.
    """
    varied = [each for each in inputs if isinstance(each, Varied)]
    matters = varied[0].matters
    value = function(*(each.value if isinstance(each, Varied) else each for each in inputs))
    settings = {setting for each in varied for setting in each.others}
    others = {
        setting: function(*(each.others.get(setting, each.value) if isinstance(each, Varied) else each for each in inputs))
        for setting in settings
    }
    if isinstance(value, bool) or getattr(value, "dtype", None) is np.dtype(bool):
        matters.update(setting for setting, other in others.items() if np.any(other != value))
        return value
    return Varied(value, others, matters)


def _infix(name: str) -> None:
    plain: Callable[..., Any] = getattr(operator, name)
    special = f"__{name.strip('_')}__"
    setattr(Varied, special, lambda self, other: _applied(plain, (self, other)))
    if name not in _COMPARISONS:
        setattr(Varied, f"__r{special[2:]}", lambda self, other: _applied(plain, (other, self)))


def _prefix(name: str) -> None:
    plain: Callable[..., Any] = getattr(operator, name)
    setattr(Varied, f"__{name}__", lambda self: _applied(plain, (self,)))


_COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")
for _name in (*_COMPARISONS, "add", "sub", "mul", "truediv", "floordiv", "mod", "pow"):
    _infix(_name)
for _name in ("neg", "pos", "abs"):
    _prefix(_name)


class WatchedThresholds:
    """Thresholds of `gap` whose values are `Varied`: records which were used, and which settings would change a decision.

    values: the thresholds, or one group of them (with its name and a dot as prefix); others: function from a threshold's
    group.key to its values under other settings; asked, matters: sets to which used keys and deciding settings are added.
    """

    def __init__(
        self,
        values: Any,
        others: Callable[[str], dict[Setting, Any]],
        asked: set[str],
        matters: set[Setting],
        prefix: str = "",
    ) -> None:
        self._values, self._others, self._asked, self._matters, self._prefix = values, others, asked, matters, prefix

    def __getattr__(self, name: str) -> Any:
        """Return a group, or the value of a threshold, which is recorded as used."""
        found = getattr(self._values, name)
        if name.startswith("model_"):
            return found
        if not self._prefix:
            return WatchedThresholds(found, self._others, self._asked, self._matters, f"{name}.")
        key = f"{self._prefix}{name}"
        self._asked.add(key)
        return Varied(found, self._others(key), self._matters)

"""Words of sentences with numbers in them."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as "1 block" and "2,000 blocks". The noun's plural ends in s."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"

"""Words of sentences with numbers in them."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Format a number with its noun in singular or plural, such as "1 block" and "2,000 blocks".

    `noun` is the singular, and its plural ends in s.
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"

"""A log that tells of every kind of trouble and never grows with how often it happens."""

from __future__ import annotations

from collections.abc import Callable

_KINDS = 200  # further ones are told together
_LONGEST = 400  # characters of a line


class Sampler:
    """Says the first of a kind, the tenth, the hundredth and so on."""

    def __init__(self, say: Callable[[str], None]) -> None:
        """Nothing said yet."""
        self._say = say
        self._counts: dict[str, int] = {}

    def say(self, kind: str, text: str) -> None:
        """Tell ``text`` if enough of its ``kind`` have come; nothing in it can write over a terminal."""
        kind = kind if kind in self._counts or len(self._counts) < _KINDS else "others"
        count = self._counts.get(kind, 0) + 1
        self._counts[kind] = count
        if count == 10 ** (len(str(count)) - 1):
            plain = "".join(letter if letter.isprintable() else "?" for letter in text[:_LONGEST])
            self._say(plain if count == 1 else f"{plain} ({count} of this kind so far)")

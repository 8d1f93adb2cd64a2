"""A log that reports every kind of trouble, and stays short however often it happens."""

from __future__ import annotations

from collections.abc import Callable

_MOST_KINDS = 200  # further ones are counted together
_LONGEST = 400  # characters of a line


class RateLimitedLog:
    """Passes on the first message of a kind, the tenth, the hundredth and so on."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._counts: dict[str, int] = {}

    def write(self, kind: str, text: str) -> None:
        """Count a message of a ``kind`` and pass it on if it is due; a sender's text in it is made harmless."""
        kind = kind if kind in self._counts or len(self._counts) < _MOST_KINDS else "others"
        count = self._counts[kind] = self._counts.get(kind, 0) + 1
        if count == 10 ** (len(str(count)) - 1):
            plain = "".join(letter if letter.isprintable() else "?" for letter in text[:_LONGEST])
            self._notify(plain if count == 1 else f"{plain} ({count} of this kind so far)")

"""Whole lines out of a stream's pieces."""

from __future__ import annotations

LONGEST = 64 * 1024  # bytes of a line


class Lines:
    """Whole lines out of pieces of any length.

    Of one that is longer than 64 KiB only as much is given, once, that its reader sees it to be too long.
    """

    def __init__(self) -> None:
        """Nothing begun."""
        self._torn, self._too_long = b"", False

    def cut(self, piece: bytes) -> list[bytes]:
        """The lines that end in this piece."""
        *lines, rest = piece.split(b"\n")
        if lines:
            lines[0] = self._torn + lines[0]
            if self._too_long:
                del lines[0]
            self._torn, self._too_long = b"", False
        if not self._too_long:
            self._torn += rest
        if len(self._torn) > LONGEST:
            lines.append(self._torn)
            self._torn, self._too_long = b"", True
        return lines

    def rest(self) -> list[bytes]:
        """What is left without an end when no more comes."""
        left, self._torn = self._torn, b""
        return [left] if left else []

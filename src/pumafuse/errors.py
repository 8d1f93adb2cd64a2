"""Errors and warnings: one line each that says what is wrong, where, and what to do."""

from __future__ import annotations

import difflib
import re
import warnings
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

_LONGEST_NAME, _LONGEST = 120, 2000  # characters


class PumafuseError(Exception):
    """Base of every error a user can cause; its text is one line fit for a screen."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text, _LONGEST))


class ConfigError(PumafuseError):
    """A configuration file or value is wrong."""


class RunError(PumafuseError):
    """A recorded run, or a table of one, cannot be read as written."""


class UnknownNameError(PumafuseError):
    """A name that is not among the accepted ones.

    Attributes:
        name: The name as given.
        accepted: The names that would have been accepted.
    """

    def __init__(self, where: str, kind: str, name: str, accepted: Iterable[str]) -> None:
        self.name = name
        self.accepted = tuple(accepted)
        super().__init__(f"{where}: unknown {kind} '{shortened(name)}'; {suggestion(name, self.accepted)}")


class PumafuseWarning(UserWarning):
    """A fault of the data or the model that does not stop the work; one line fit for a screen."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text, _LONGEST))


def warn(sentences: Iterable[str]) -> None:
    """Give each sentence as a warning of the caller."""
    for sentence in sentences:
        warnings.warn(sentence, PumafuseWarning, stacklevel=3)


def printable(text: str, longest: int = 80) -> str:
    """A text that may have words of a log in it for a screen: one line, no control characters, not too long."""
    line = " ".join(text.splitlines())
    if not line.isprintable():
        line = "".join(letter if letter.isprintable() else "?" for letter in line)
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


def suggestion(name: str, accepted: Iterable[str]) -> str:
    """The accepted names in a sentence, the closest to ``name`` first when one is close."""
    names = list(accepted)
    close = difflib.get_close_matches(name, names, n=1)
    listed = f"accepted: {', '.join(names)}" if names else "nothing is accepted here"
    return f"did you mean '{close[0]}'? {listed}" if close else listed


def shortened(name: str) -> str:
    """A name as given, cut where it would fill a screen."""
    return name if len(name) <= _LONGEST_NAME else f"{name[:_LONGEST_NAME]}…"


def plural(number: int, what: str) -> str:
    """``1 cell``, ``2 cells``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def unknown_part(path: Path, key: str, name: str, parts: Mapping[str, str], notes: Sequence[str]) -> RunError:
    """What to say where a recording has nothing of a name: what it has, with the types."""
    why = "".join(f"; {note.removeprefix(f'{path.name}: ')}" for note in notes)
    if not parts:
        return RunError(f"{path}: the recording is empty{why}")
    if name in parts:
        return RunError(f"{path}: {key} '{name}' has nothing that can be read{why}")
    guess, near, _ = suggestion(name, parts).partition("?")
    asked = f"no {key} '{name}'" if name else f"the key '{key}' is missing"
    listed = ", ".join(f"{part} ({kind})" for part, kind in parts.items())
    return RunError(f"{path}: {asked}; {f'{guess}? ' if near else ''}it has: {listed}{why}")


def reason(error: Exception) -> str:
    """What an error says, without the file that it names, in a line that is short enough for a screen."""
    text = re.sub(r"^Failed to read RRD file at .*?\.rrd: ", "", str(error))
    return " ".join(text.split())[:160].rstrip(". :") or type(error).__name__


@contextmanager
def one_line(path: Path, libraries: str) -> Generator[None]:
    """Turn what libraries raise while they read a file into an error of one line; pip installs ``libraries``."""
    try:
        yield
    except RunError:
        raise
    except ModuleNotFoundError:
        raise RunError(f"{path}: this format needs more libraries: pip install {libraries}") from None
    except FileNotFoundError:
        raise RunError(f"{path}: no such file") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or reason(error)}") from None
    except MemoryError:
        raise RunError(f"{path}: cannot be read: not enough memory") from None
    except Exception as error:
        raise RunError(f"{path}: cannot be read: {reason(error)}") from None

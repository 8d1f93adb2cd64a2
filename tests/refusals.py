"""The message of a refusal."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from pumafuse.errors import PumafuseError


def one_line(kind: type[PumafuseError], call: Callable[[], object]) -> str:
    """The text of the error that the call must raise, which must be one line."""
    with pytest.raises(kind) as caught:
        call()
    text = str(caught.value)
    assert len(text.splitlines()) == 1, text
    return text

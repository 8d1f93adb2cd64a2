"""The message of a refusal, and a worker process that dies."""

import os
from collections.abc import Callable
from typing import Any

import pytest

from pumafuse.errors import PumafuseError


def one_line(kind: type[PumafuseError], call: Callable[[], object]) -> str:
    """The text of the error that the call must raise, which must be one line."""
    with pytest.raises(kind) as caught:
        call()
    text = str(caught.value)
    assert len(text.splitlines()) == 1, text
    return text


def killed_beside(parent: int, work: Callable[..., Any], *given: Any) -> Any:
    """What a system that runs out of memory does to every process but the ``parent``, which does the work."""
    if os.getpid() != parent:
        os._exit(9)
    return work(*given)

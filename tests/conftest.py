"""What tests need before any of them runs."""

import os
import signal

import pytest
from hypothesis import settings

settings.register_profile("same", derandomize=True, deadline=None)  # the same examples each time, on any machine
settings.load_profile("same")


def pytest_configure(config: pytest.Config) -> None:
    """Make signals heard, and give each worker a core to itself: threads of several would wait for one another.

    Who starts the tests in the background, or with nohup, may have made them and all that they start deaf to signals.
    """
    if hasattr(config, "workerinput"):
        os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads and worker processes, where a worker of the tests has none."""
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "2")

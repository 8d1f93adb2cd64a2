"""`pumafuse live` as a process that listens, and whose estimates come to us."""

import contextlib
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path

from executable import EXECUTABLE
from pumafuse.live.network import Items, Remote

LONGEST = 60.0  # s that anything here may take


def until(source: Remote, enough: Callable[[Items], object]) -> Items:
    """Lines or events of a source as they come, until there are enough."""
    taken, give_up = [], time.monotonic() + LONGEST
    while not enough(taken):
        assert time.monotonic() < give_up, taken[-10:]
        taken += source.get()
    return taken


class Live:
    """A live process whose estimates come to a socket of ours."""

    def __init__(self, source: str, config: Path, *options: str, out: bool = True) -> None:
        self.estimates = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.estimates.bind(("127.0.0.1", 0))
        self.estimates.settimeout(LONGEST)
        self.estimates.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        words = [str(EXECUTABLE), "live", source, "-c", str(config), *options]
        words += ["--out", f"udp://127.0.0.1:{self.estimates.getsockname()[1]}"] if out else []
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def until(self, words: str) -> str:
        """Read the log up to a sentence with these words."""
        assert self.process.stderr is not None
        last, log = threading.Timer(LONGEST, self.process.kill), ""
        last.start()
        while words not in log and (line := self.process.stderr.readline()):
            log += line
        last.cancel()
        assert words in log, f"it ended without '{words}': {log}"
        return log

    def port(self) -> int:
        return int(self.until("listening at").rsplit(":", 1)[1])

    def received(self, count: int) -> list[bytes]:
        return [self.estimates.recv(65536) for _ in range(count)]

    def end(self, number: int = signal.SIGTERM) -> str:
        """Ask for an end; what was logged."""
        self.process.send_signal(number)
        out, log = self.process.communicate(timeout=LONGEST)
        assert self.process.returncode == 0, log
        assert "Traceback" not in log
        assert out == ""
        return log


@contextlib.contextmanager
def live(source: str, config: Path, *options: str, out: bool = True) -> Generator[Live]:
    process = Live(source, config, *options, out=out)
    try:
        yield process
    finally:
        process.process.kill()
        process.process.communicate()
        process.estimates.close()

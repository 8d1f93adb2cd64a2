"""`pumafuse live` as a process that listens, and whose estimates come to us."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
from collections.abc import Generator
from pathlib import Path

from executable import EXECUTABLE

LONGEST = 60.0  # s that anything here may take


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

    def port(self) -> int:
        assert self.process.stderr is not None
        for notice in self.process.stderr:
            if "listening at" in notice:
                return int(notice.rsplit(":", 1)[1])
        raise AssertionError(self.process.wait())

    def received(self, count: int) -> list[bytes]:
        return [self.estimates.recv(65536) for _ in range(count)]

    def memory(self) -> int:
        """Resident memory [kB]."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0])

    def end(self, number: int = signal.SIGTERM) -> str:
        """Ask for an end; what was logged."""
        self.process.send_signal(number)
        out, log = self.process.communicate(timeout=LONGEST)
        assert self.process.returncode == 0, log
        assert "Traceback" not in log
        assert out == ""
        return log


@contextlib.contextmanager
def live(source: str, config: Path, *options: str) -> Generator[Live]:
    process = Live(source, config, *options)
    try:
        yield process
    finally:
        process.process.kill()
        process.process.communicate()
        process.estimates.close()

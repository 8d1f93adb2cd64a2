"""The viewer that a live view draws into: started here, or found running; on this machine's loopback only."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

from . import live_page
from .live_frames import Header
from .live_page import HOST

_VIEWER_MEMORY = "1GiB"
_BEHIND_VIEWER = "64MiB"  # of its own server, which only hands on
_SERVER_MEMORY = "32MiB"  # what a browser gets that is opened later: more than the seconds that are shown
_OPENED_WITHIN = 30.0  # s
_FIRST_PAUSE, _LONGEST_PAUSE = 0.2, 5.0  # s between looks for a viewer


class Viewer:
    """Where to draw.

    Attributes:
        url: For rerun-sdk.
        own: The process of a viewer or a server started here; None for one that was running.
    """

    def __init__(self, header: Header, say: Callable[[str], None]) -> None:
        """Start a viewer or a server, unless one is there; on free ports where the usual ones are taken."""
        self.own: subprocess.Popen[bytes] | None = None
        self._header, self._say, self._told = header, say, False
        self._opened = False
        self._port = header.port
        if header.mode != "connect":
            self._port = _free(header.port)
            self._web_port, self._behind = _free(header.web_port), _free(0)
            self.own = _start(_arguments(header.mode, self._port, self._behind), keep=header.mode == "spawn")
        self.url = f"rerun+http://{HOST}:{self._port}/proxy"

    def wait(self) -> bool:
        """Wait until the viewer listens, and say where it is; whether it ever will."""
        begin, pause = time.monotonic(), _FIRST_PAUSE
        while not _listens(self._port) or (self._header.mode == "web" and not _listens(self._behind)):
            if self.own is None:
                self._once(f"Rerun: no viewer listens at {self.url}; it is drawn into as soon as one does")
            elif self.gone or time.monotonic() - begin > _OPENED_WITHIN:
                self._say(f"Rerun: {self._missing()}; nothing is drawn")
                return False
            time.sleep(pause)
            pause = pause if self.own else min(2.0 * pause, _LONGEST_PAUSE)
        self._told = False
        if self.own is None or not self._opened:
            self._say(f"Rerun: {self._found()}")
        self._opened = True
        return True

    def _missing(self) -> str:
        if self._opened:
            return "the viewer was closed"
        screen = "; is there a screen? --rerun web needs none" if self._header.mode == "spawn" else ""
        return f"the viewer cannot be started{screen}"

    def _found(self) -> str:
        if self._header.mode != "web":
            return f"drawing into the viewer at {self.url}"
        live_page.serve(self._web_port, self._behind, self._port)
        return f"open http://{HOST}:{self._web_port}/?url={quote(self.url, safe='')}"

    @property
    def gone(self) -> bool:
        """Whether the viewer was started here and has ended."""
        return self.own is not None and self.own.poll() is not None

    def end(self) -> None:
        """End a server started here; a viewer's window stays open."""
        if self.own is not None and self._header.mode == "web":
            self.own.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.own.wait(0.3)
            self.own.kill()

    def _once(self, text: str) -> None:
        if not self._told:
            self._say(text)
        self._told = True


def _arguments(mode: str, port: int, web_port: int) -> list[str]:
    given = ["--bind", HOST, "--port", str(port)]
    if mode == "web":
        server = ["--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", _SERVER_MEMORY]
        return [*given, *server, "--newest-first"]  # oldest first, a browser opened later would begin far behind
    limits = ["--memory-limit", _VIEWER_MEMORY, "--server-memory-limit", _BEHIND_VIEWER]
    return [*given, *limits, "--hide-welcome-screen", "--expect-data-soon"]


def _start(arguments: list[str], *, keep: bool) -> subprocess.Popen[bytes]:
    """Run the viewer's own program; ``keep`` it running after us."""
    environment = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    quiet = {"CI": "1", "RUST_LOG": "off", "TELEMETRY_ENABLED": "false"}  # CI: what turns its usage statistics off
    return subprocess.Popen(
        [_program(), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment | quiet,
        start_new_session=keep,
    )


def _program() -> str:
    """The viewer of rerun-sdk itself: its script of the same name would stay behind it, and hide its end."""
    found = importlib.util.find_spec("rerun_cli")
    assert found is not None and found.origin is not None
    folder = Path(found.origin).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else folder / "rerun")


def _free(port: int) -> int:
    """The port, or a free one where it is taken."""
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind((HOST, port))
        except OSError:
            taken.bind((HOST, 0))
        return int(taken.getsockname()[1])


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((HOST, port), 0.5):
        return True
    return False

"""The viewer that a live view draws into: started here, or found running; on this machine's loopback only.

The web viewer's page would send usage statistics, ask for newer versions, examples and fonts, and has no switch for it.
The browser keeps it from that when the page's policy says so; hence the page passes through :func:`_serve`.
"""

from __future__ import annotations

import contextlib
import http.client
import importlib.util
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

from .live import Header

HOST = "127.0.0.1"
_VIEWER_MEMORY = "1GiB"
_BEHIND_VIEWER = "64MiB"  # of its own server, which only hands on
_SERVER_MEMORY = "32MiB"  # what a browser gets that is opened later: more than the seconds that are shown
_OPENED_WITHIN = 30.0  # s
_PAUSE = 0.5  # s between two tries to find a viewer
_PASSED_ON = ("Content-Type", "rerun-final-length")  # headers of the page
_WAIT = 30.0  # s for Rerun's own server


class Viewer:
    """The viewer, or the server of its page.

    Attributes:
        url: Where rerun-sdk draws.
    """

    def __init__(self, header: Header, report: Callable[[str], None]) -> None:
        """Start a viewer or a server, unless one is there; on free ports where the usual ones are taken."""
        self._own: subprocess.Popen[bytes] | None = None
        self._mode, self._report, self._opened = header.mode, report, False
        self._port = header.port
        if self._mode != "connect":
            self._port = _free(header.port)
            self._web_port, self._behind = _free(header.web_port), _free(0)
            self._own = _start(_arguments(self._mode, self._port, self._behind), keep=self._mode == "spawn")
        self._awaited = [self._port, self._behind] if self._mode == "web" else [self._port]
        self.url = f"rerun+http://{HOST}:{self._port}/proxy"

    def wait(self) -> bool:
        """Wait until the viewer listens, and report where it is; whether it ever will."""
        begin, reported = time.monotonic(), False
        while not all(map(_listens, self._awaited)):
            if self._own is None and not reported:
                self._report(f"Rerun: no viewer listens at {self.url}; it is drawn into as soon as one does")
                reported = True
            elif self._own and (self._own.poll() is not None or time.monotonic() - begin > _OPENED_WITHIN):
                screen = "; is there a screen? --rerun web needs none" if self._mode == "spawn" else ""
                why = "was closed" if self._opened else f"cannot be started{screen}"
                self._report(f"Rerun: the viewer {why}; nothing is drawn")
                return False
            time.sleep(_PAUSE)
        if self._mode == "web" and not self._opened:
            _serve(self._web_port, self._behind, self._port)
            self._report(f"Rerun: open http://{HOST}:{self._web_port}/?url={quote(self.url, safe='')}")
        elif self._own is None or not self._opened:
            self._report(f"Rerun: drawing into the viewer at {self.url}")
        self._opened = True
        return True

    def end(self) -> None:
        """End a server started here; a viewer's window stays open."""
        if self._own is not None and self._mode == "web":
            self._own.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._own.wait(0.3)
            self._own.kill()


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


def _serve(port: int, behind: int, viewer: int) -> None:
    """Serve the web viewer's page in the background, so that it speaks with nobody but its server on this machine.

    Args:
        port: Where the browser finds it.
        behind: Where Rerun serves it.
        viewer: Of the server that the page may speak with.
    """
    allowed = f"'self' http://{HOST}:{viewer}"
    policy = f"default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:; connect-src {allowed}"

    ours = {f"{name}:{port}" for name in ("localhost", "127.0.0.1", "[::1]")}

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.headers.get("Host", "").lower() not in ours:  # another page whose name leads here
                self.send_error(http.HTTPStatus.MISDIRECTED_REQUEST)
                return
            behind_it = http.client.HTTPConnection(HOST, behind, timeout=_WAIT)
            try:
                behind_it.request("GET", self.path.partition("?")[0])
                answer = behind_it.getresponse()
                self.send_response(answer.status)
                for name in _PASSED_ON:
                    if value := answer.headers.get(name):
                        self.send_header(name, value)
                self.send_header("Content-Security-Policy", policy)
                self.end_headers()
                shutil.copyfileobj(answer, self.wfile)
            except OSError:
                self.close_connection = True  # the browser has gone, or the server
            finally:
                behind_it.close()

        def log_message(self, format: str, *args: object) -> None:
            """Nothing: standard error is nobody's."""

    server = ThreadingHTTPServer((HOST, port), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()

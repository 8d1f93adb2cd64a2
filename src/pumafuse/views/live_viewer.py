"""The viewer that a live view draws into: started here, or found running; on this machine's loopback only.

What a browser reaches of the web viewer passes through here, by loopback's names only. A page from elsewhere whose name
is made to lead to this machine (DNS rebinding) could read it otherwise; its requests carry that name as their Host.

The web viewer's page would send usage statistics, ask for newer versions, examples and fonts, and has no switch for it.
The browser keeps it from that where the page's policy says so.
"""

from __future__ import annotations

import contextlib
import http.client
import importlib.util
import io
import os
import socket
import socketserver
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

from .live import Header

HOST = "127.0.0.1"
_VIEWER_MEMORY = "1GiB"
_BEHIND_VIEWER = "64MiB"  # of its own server, which only hands on
_SERVER_MEMORY = "32MiB"  # what a browser gets that is opened later: more than the seconds that are shown
_OPENED_WITHIN = 30.0  # s
_PAUSE = 0.5  # s between two tries to find a viewer
_WAIT = 30.0  # s for a request to come whole
_POLICY = (  # the page speaks with nobody but the server of its data
    "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:; connect-src 'self' http://{}:{}"
)
_LONGEST_HEAD = 1 << 16  # bytes
_HTTP_2 = b"PRI * HTTP/2.0\r\n"  # how rerun-sdk begins; browsers do not, without encryption
_MISDIRECTED = b"HTTP/1.1 421 Misdirected Request\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class Viewer:
    """The viewer, or the server of its page."""

    def __init__(self, header: Header, report: Callable[[str], None]) -> None:
        """Start a viewer or a server, unless one is there; on free ports where the usual ones are taken."""
        self._process: subprocess.Popen[bytes] | None = None
        self._mode, self._report, self._opened = header.mode, report, False
        port = header.port if self._mode == "connect" else _free(0 if self._mode == "web" else header.port)
        self._awaited = [port]
        if self._mode == "web":
            self._web_port, self._data_port = _free(header.web_port), _free(header.port)
            self._awaited.append(_free(0))
        if self._mode != "connect":
            self._process = _start(_arguments(self._mode, *self._awaited), keep=self._mode == "spawn")
        self.url = _url(port)  # where rerun-sdk draws

    def wait(self) -> bool:
        """Wait until the viewer listens, and report where it is; whether it ever will."""
        begin, reported = time.monotonic(), False
        while not all(map(_listens, self._awaited)):
            if self._process is None and not reported:
                self._report(f"Rerun: no viewer listens at {self.url}; it is drawn into as soon as one does")
                reported = True
            elif self._process and (self._process.poll() is not None or time.monotonic() - begin > _OPENED_WITHIN):
                screen = "; is there a screen? --rerun web needs none" if self._mode == "spawn" else ""
                why = "was closed" if self._opened else f"cannot be started{screen}"
                self._report(f"Rerun: the viewer {why}; nothing is drawn")
                return False
            time.sleep(_PAUSE)
        if self._mode == "web" and not self._opened:
            data, page = self._awaited
            policy = _POLICY.format(HOST, self._data_port)
            for server in (_guard(self._web_port, page, policy), _guard(self._data_port, data)):
                threading.Thread(target=server.serve_forever, daemon=True).start()
            self._report(f"Rerun: open http://{HOST}:{self._web_port}/?url={quote(_url(self._data_port), safe='')}")
        elif self._process is None or not self._opened:
            self._report(f"Rerun: drawing into the viewer at {self.url}")
        self._opened = True
        return True

    def end(self) -> None:
        """End a server started here; a viewer's window stays open."""
        if self._process is not None and self._mode == "web":
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.3)
            self._process.kill()


def _url(port: int) -> str:
    return f"rerun+http://{HOST}:{port}/proxy"


def _arguments(mode: str, port: int, web_port: int | None = None) -> list[str]:
    options = ["--bind", HOST, "--port", str(port)]
    if mode == "web":
        server = ["--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", _SERVER_MEMORY]
        return [*options, *server, "--newest-first"]  # oldest first, a browser opened later would begin far behind
    limits = ["--memory-limit", _VIEWER_MEMORY, "--server-memory-limit", _BEHIND_VIEWER]
    return [*options, *limits, "--hide-welcome-screen", "--expect-data-soon"]


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
    spec = importlib.util.find_spec("rerun_cli")
    assert spec is not None and spec.origin is not None
    folder = Path(spec.origin).parent
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


# ---- what a browser reaches ------------------------------------------------------------------------------------------


def _guard(port: int, rerun: int, policy: str = "") -> socketserver.BaseServer:
    """Hands connections on to a server of Rerun, byte by byte, once the first request says where it wants to go.

    A browser asks only one host on one connection, so the first request speaks for all. With a policy for the browser
    it is the only one: Rerun ends a connection of HTTP/1.0 after its answer.
    """

    class Connection(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            with contextlib.suppress(OSError):  # either side has gone
                self.request.settimeout(_WAIT)
                head = _head(self.request)
                if not head.startswith(_HTTP_2) and not _is_ours(head, port):
                    self.request.sendall(_MISDIRECTED)
                    return
                self.request.settimeout(None)
                with socket.create_connection((HOST, rerun)) as behind_it:
                    if policy:
                        path = head.partition(b" ")[2].partition(b" ")[0].partition(b"?")[0]
                        behind_it.sendall(b"GET %b HTTP/1.0\r\n\r\n" % path)
                        header = f"\r\nContent-Security-Policy: {policy}\r\n".encode()
                        self.request.sendall(_head(behind_it).replace(b"\r\n", header, 1))
                        _copy(behind_it, self.request)
                    else:
                        behind_it.sendall(head)
                        threading.Thread(target=_copy, args=(behind_it, self.request), daemon=True).start()
                        _copy(self.request, behind_it)

    class Server(socketserver.ThreadingTCPServer):
        allow_reuse_address = daemon_threads = True

    return Server((HOST, port), Connection)


def _head(connection: socket.socket) -> bytes:
    """What comes first, to the end of a request's or an answer's headers at least."""
    head = b""
    while b"\r\n\r\n" not in head and len(head) < _LONGEST_HEAD:
        if not (more := connection.recv(_LONGEST_HEAD)):
            break
        head += more
    return head


def _is_ours(head: bytes, port: int) -> bool:
    """Whether the Host of a request of HTTP/1 is this machine's loopback."""
    with contextlib.suppress(http.client.HTTPException):
        host = http.client.parse_headers(io.BytesIO(head.partition(b"\r\n")[2])).get("Host", "")
        return host.lower() in {f"{name}:{port}" for name in ("localhost", HOST, "[::1]")}
    return False


def _copy(source: socket.socket, target: socket.socket) -> None:
    """Hand on what comes, to its end; then neither side waits for the other any longer."""
    with contextlib.suppress(OSError):
        while part := source.recv(1 << 16):
            target.sendall(part)
    for stream in (source, target):
        with contextlib.suppress(OSError):
            stream.shutdown(socket.SHUT_RDWR)

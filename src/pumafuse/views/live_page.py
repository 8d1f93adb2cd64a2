"""The page of Rerun's web viewer, served so that it speaks with nobody but its server on this machine.

The viewer in the browser would send usage statistics, ask for newer versions, examples and fonts, and has no switch
for it. The browser keeps it from that when the page's policy says so; hence all of the page passes through here.
"""

from __future__ import annotations

import http.client
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

HOST = "127.0.0.1"
_PASSED_ON = ("Content-Type", "rerun-final-length")
_WAIT = 30.0  # s


def serve(port: int, behind: int, viewer: int) -> None:
    """Serve the page in the background.

    Args:
        port: Where the browser finds it.
        behind: Where Rerun serves it.
        viewer: Of the server that the page may speak with.
    """
    allowed = f"'self' http://{HOST}:{viewer}"
    policy = f"default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:; connect-src {allowed}"

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
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

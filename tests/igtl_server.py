"""A process of its own that sends poses by pyigtl's server of OpenIGTLink; run as a script.

    python igtl_server.py PORT POSES

POSES is a JSON list of ``[seconds, device, matrix]``; they go out one by one once somebody has connected.
"""

import json
import sys
import time
from pathlib import Path

import pyigtl


def main(port: str, poses: str) -> None:
    server = pyigtl.OpenIGTLinkServer(port=int(port))
    while not server.is_connected():
        time.sleep(0.01)
    for stamp, device, matrix in json.loads(Path(poses).read_text()):
        server.send_message(pyigtl.TransformMessage(matrix, timestamp=stamp, device_name=device), wait=True)
    time.sleep(0.5)
    server.stop()


if __name__ == "__main__":
    main(*sys.argv[1:])

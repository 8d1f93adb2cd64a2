"""How fast estimates come back over the network: datagrams in and out on loopback, and lines over TCP.

    python benchmarks/network.py [--seconds S] [--rows N]

Three axes, the shipped configuration: rows at 1 kHz and commands at 36 Hz as datagrams, an estimate for each command as
a datagram; the time from sending a command to receiving its estimate. Then as many rows as go through a TCP connection.
"""

from __future__ import annotations

import argparse
import json
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import numpy as np

DATA = Path(str(files("pumafuse") / "data"))
START = {"tangential": 0.0, "radial": 560.0, "vertical": -100.0}


@contextmanager
def live(source: str, *options: str) -> Iterator[tuple[int, subprocess.Popen[str]]]:
    """A live process that listens, and its port."""
    command = [sys.executable, "-c", "from pumafuse.cli.main import main; main()", "live", source]
    command += ["-c", str(DATA / "fusion.toml"), *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        said = ""
        while "listening at" not in said:
            said = process.stderr.readline()
            if not said:
                sys.exit(f"the live process ended with {process.wait()}")
        yield int(said.rsplit(":", 1)[1]), process
        process.send_signal(signal.SIGTERM)
        print("    " + process.stderr.read().replace("\n", "\n    ").rstrip())


def command(t_ns: int) -> bytes:
    """A command at a time."""
    return json.dumps({"t_ns": t_ns, "command": START}).encode()


def row(t_ns: int) -> bytes:
    """A measurement at a time."""
    return json.dumps({"t_ns": t_ns, "sensor": "tracker", **START}).encode()


def latencies(seconds: float) -> np.ndarray:
    """From each command's datagram to its estimate's [ms]."""
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind(("127.0.0.1", 0))
    out = f"udp://127.0.0.1:{ours.getsockname()[1]}"
    with live("udp://127.0.0.1:0", "--out", out) as (port, _):
        place, sent, found = ("127.0.0.1", port), {}, []
        begin, step = time.perf_counter(), 0
        while step < seconds * 1000 or (sent and time.perf_counter() - begin < seconds + 1.0):
            wait = begin + step / 1000 - time.perf_counter()
            if select.select([ours], [], [], max(wait, 0.0))[0]:
                came = time.perf_counter()
                at = sent.pop(json.loads(ours.recv(65536))["t_ns"], None)
                if at is not None:
                    found.append((came - at) * 1e3)
                continue
            if step >= seconds * 1000:
                continue
            stamp = time.time_ns()
            if step % 28 == 0:
                sent[stamp] = time.perf_counter()
                ours.sendto(command(stamp), place)
            ours.sendto(row(stamp), place)
            step += 1
        if sent:
            print(f"    {len(sent)} commands without an estimate")
    return np.array(found[20:])


def through_tcp(rows: int) -> float:
    """Rows a second that go through a connection."""
    lines = b"".join(
        (command(step * 1_000_000) + b"\n" if step % 28 == 0 else b"") + row(step * 1_000_000) + b"\n"
        for step in range(rows)
    )
    end = f'{{"t_ns": {rows * 1_000_000}, "command": {json.dumps(START)}}}\n'.encode()
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind(("127.0.0.1", 0))
    out = f"udp://127.0.0.1:{ours.getsockname()[1]}"
    with live("tcp-listen://127.0.0.1:0", "--out", out) as (port, _):
        begin = time.perf_counter()
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(lines + end)
        while json.loads(ours.recv(65536))["t_ns"] < rows * 1_000_000:
            pass
        return rows / (time.perf_counter() - begin)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of datagrams")
    parser.add_argument("--rows", type=int, default=200_000, help="over TCP")
    arguments = parser.parse_args()
    found = latencies(arguments.seconds)
    shown = ", ".join(f"{name} {np.percentile(found, share):.3f} ms" for name, share in (("50 %", 50), ("99 %", 99)))
    print(f"datagram in to estimate out: {shown}, most {found.max():.3f} ms ({len(found)} commands)")
    print(f"over TCP: {through_tcp(arguments.rows):,.0f} rows a second")


if __name__ == "__main__":
    main()

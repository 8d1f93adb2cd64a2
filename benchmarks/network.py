"""How fast estimates come back over the network, for one robot or many on one machine, and what goes through TCP.

    python benchmarks/network.py [--robots 1,10,20,40] [--hz RATE] [--seconds S] [--rows N]

Each robot is a live process with its record, fed with datagrams on loopback at its own pace: commands at 36 Hz and a
tracker on three axes, an estimate for each command as a datagram. What is measured: from a command's datagram to its
estimate's, lost datagrams, CPU time and memory. Then as many rows as go through a TCP connection.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

DATA = Path(str(files("pumafuse") / "data"))
PLACE = {"tangential": 0.0, "radial": 560.0, "vertical": -100.0}
COMMAND_S = 0.028


@dataclass
class Robot:
    """One live process that listens."""

    process: subprocess.Popen[str]
    port: int

    @staticmethod
    def start(source: str, *options: str) -> Robot:
        """With the shipped configuration."""
        command = [sys.executable, "-c", "from pumafuse.cli.main import main; main()", "live", source]
        command += ["-c", str(DATA / "fusion.toml"), *options]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        for said in process.stderr:
            if "listening at" in said:
                return Robot(process, int(said.rsplit(":", 1)[1]))
        sys.exit(f"the live process ended with {process.wait()}")

    def usage(self) -> tuple[float, float]:
        """CPU time [s] and the memory that is its share [MB]."""
        words = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        share = Path(f"/proc/{self.process.pid}/smaps_rollup").read_text()
        cpu = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        return cpu, int(share.split("Pss:")[1].split()[0]) / 1024

    def end(self) -> str:
        """What it reports."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.communicate()[1]


def receiver() -> tuple[socket.socket, str]:
    """A socket for estimates, and its address."""
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind(("127.0.0.1", 0))
    ours.settimeout(60.0)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    return ours, f"udp://127.0.0.1:{ours.getsockname()[1]}"


def event(t_ns: int, command: bool) -> bytes:
    """A command or a measurement at a time."""
    return json.dumps({"t_ns": t_ns, **({"command": PLACE} if command else {"sensor": "tracker", **PLACE})}).encode()


def followed(number: int, hz: float, seconds: float, folder: Path) -> str:
    """A row of the table."""
    ours, out = receiver()
    robots = [Robot.start("udp://127.0.0.1:0", "--out", out, "--record", str(folder / str(n))) for n in range(number)]
    begin = time.perf_counter()
    due = [(begin + n * period / number, n, period) for n in range(number) for period in (COMMAND_S, 1.0 / hz)]
    heapq.heapify(due)
    sent: dict[int, float] = {}
    found: list[float] = []
    before = [robot.usage()[0] for robot in robots]
    while due[0][0] < begin + seconds:
        if select.select([ours], [], [], max(due[0][0] - time.perf_counter(), 0.0))[0]:
            came = time.perf_counter()
            found.append((came - sent.pop(json.loads(ours.recv(65536))["t_ns"])) * 1e3)
            continue
        at, n, period = due[0]
        heapq.heapreplace(due, (at + period, n, period))
        stamp = time.time_ns()
        if period == COMMAND_S:
            sent[stamp] = time.perf_counter()
        ours.sendto(event(stamp, period == COMMAND_S), ("127.0.0.1", robots[n].port))
    usage = [robot.usage() for robot in robots]
    cpu = sum(now - then for (now, _), then in zip(usage, before, strict=True)) / seconds
    lost = sum(int(robot.end().split(" taken in, ")[1].split()[0]) for robot in robots)
    half, most = np.percentile(found[20:], [50, 99])
    return f"| {number} | {cpu:.2f} | {sum(share for _, share in usage):.0f} | {half:.2f} | {most:.2f} | {lost} |"


def through_tcp(rows: int) -> float:
    """Rows a second that go through a connection."""
    end = rows * 1_000_000
    stamped = [
        (t, command)
        for t in range(0, end, 1_000_000)
        for command in (True, False)
        if not command or t % 28_000_000 == 0
    ]
    lines = [event(t, command) for t, command in (*stamped, (end, True))]
    ours, out = receiver()
    robot = Robot.start("tcp-listen://127.0.0.1:0", "--out", out)
    begin = time.perf_counter()
    with socket.create_connection(("127.0.0.1", robot.port)) as connection:
        connection.sendall(b"\n".join(lines) + b"\n")
    while json.loads(ours.recv(65536))["t_ns"] < end:
        pass
    seconds = time.perf_counter() - begin
    robot.end()
    return rows / seconds


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", default="1", help="how many at once, a table's row for each number")
    parser.add_argument("--hz", type=float, default=1000.0, help="measurements a second of each")
    parser.add_argument("--seconds", type=float, default=30.0, help="of datagrams")
    parser.add_argument("--rows", type=int, default=200_000, help="over TCP")
    given = parser.parse_args()
    print(f"{os.cpu_count()} cores\n\n| robots | cores used | memory, MB | 50 %, ms | 99 %, ms | lost |")
    print("|---|---|---|---|---|---|")
    for number in map(int, given.robots.split(",")):
        with tempfile.TemporaryDirectory() as folder:
            print(followed(number, given.hz, given.seconds, Path(folder)), flush=True)
    print(f"\nover TCP: {through_tcp(given.rows):,.0f} rows a second")


if __name__ == "__main__":
    main()

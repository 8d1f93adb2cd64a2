"""How many robots one machine can follow: a live process each, all fed by datagrams at their own pace.

    python benchmarks/robots.py [--robots 1,10,20] [--seconds S]

Each robot: commands at 36 Hz and a tracker at 100 Hz on three axes, with its record, an estimate for each command as a
datagram. What is measured: from a command's datagram to its estimate's, lost datagrams, CPU time and memory.
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
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

DATA = Path(str(files("pumafuse") / "data"))
PLACE = {"tangential": 0.0, "radial": 560.0, "vertical": -100.0}
COMMAND_S, ROW_S = 0.028, 0.01


@dataclass
class Robot:
    """One live process."""

    process: subprocess.Popen[str]
    port: int
    sent: dict[int, float] = field(default_factory=dict)

    def usage(self) -> tuple[float, float]:
        """CPU time [s] and the memory that is its share [MB]."""
        words = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        share = Path(f"/proc/{self.process.pid}/smaps_rollup").read_text()
        cpu = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        return cpu, int(share.split("Pss:")[1].split()[0]) / 1024


def started(number: int, out: str, folder: Path) -> list[Robot]:
    """Robots that listen."""
    command = [sys.executable, "-c", "from pumafuse.cli.main import main; main()", "live", "udp://127.0.0.1:0"]
    command += ["-c", str(DATA / "fusion.toml"), "--out", out]
    found = []
    for one in range(number):
        words = [*command, "--record", str(folder / str(one))]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        found.append(Robot(process, int(process.stderr.readline().rsplit(":", 1)[1])))
    return found


def followed(number: int, seconds: float, folder: Path) -> str:
    """A row of the table."""
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind(("127.0.0.1", 0))
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    robots = started(number, f"udp://127.0.0.1:{ours.getsockname()[1]}", folder)
    begin = time.perf_counter()
    due = [(begin + robot * COMMAND_S / number, robot, COMMAND_S) for robot in range(number)]
    due += [(begin + robot * ROW_S / number, robot, ROW_S) for robot in range(number)]
    heapq.heapify(due)
    sent: dict[int, float] = {}
    found: list[float] = []
    before = [robot.usage()[0] for robot in robots]
    while due[0][0] < begin + seconds:
        if select.select([ours], [], [], max(due[0][0] - time.perf_counter(), 0.0))[0]:
            came = time.perf_counter()
            found.append((came - sent.pop(json.loads(ours.recv(65536))["t_ns"])) * 1e3)
            continue
        _, robot, period = heapq.heapreplace(due, (due[0][0] + due[0][2], due[0][1], due[0][2]))
        stamp = time.time_ns()
        if period == COMMAND_S:
            sent[stamp] = time.perf_counter()
            line = {"t_ns": stamp, "command": PLACE}
        else:
            line = {"t_ns": stamp, "sensor": "tracker", **PLACE}
        ours.sendto(json.dumps(line).encode(), ("127.0.0.1", robots[robot].port))
    usage = [robot.usage() for robot in robots]
    cpu = sum(now - then for (now, _), then in zip(usage, before, strict=True)) / seconds
    memory = sum(share for _, share in usage)
    lost = 0
    for robot in robots:
        robot.process.send_signal(signal.SIGTERM)
        report = robot.process.communicate()[1]
        lost += int(report.split(" taken in, ")[1].split()[0])
    half, most = np.percentile(found, [50, 99])
    return f"| {number} | {cpu:.2f} | {memory:.0f} | {half:.2f} | {most:.2f} | {lost} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", default="1,10,20,40")
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} cores\n\n| robots | cores used | memory, MB | 50 %, ms | 99 %, ms | lost |")
    print("|---|---|---|---|---|---|")
    for number in map(int, arguments.robots.split(",")):
        with tempfile.TemporaryDirectory() as folder:
            print(followed(number, arguments.seconds, Path(folder)), flush=True)


if __name__ == "__main__":
    main()

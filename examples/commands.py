"""A robot controller's loop that sends each command to pumafuse; to copy.

    python examples/commands.py HOST PORT [SECONDS]

Every 28 ms, by a clock that does not drift, a position goes to the arm and, as a datagram, to `pumafuse live udp://...`.
A datagram never makes the loop wait, whether anybody receives it or not.
"""

import contextlib
import json
import math
import socket
import sys
import time

PERIOD = 0.028  # s


def next_position(t: float) -> dict[str, float]:
    """The command at a time [s], in mm or degrees by axis: here 20 mm to and fro in 10 s."""
    return {"x": 560.0 + 20.0 * math.sin(0.2 * math.pi * t), "y": 0.0, "z": -100.0}


def main() -> None:
    """Send commands until the time is up, or for ever."""
    seconds = float(sys.argv[3]) if len(sys.argv) > 3 else math.inf
    family, _, _, _, place = socket.getaddrinfo(sys.argv[1], sys.argv[2], type=socket.SOCK_DGRAM)[0]
    link = socket.socket(family, socket.SOCK_DGRAM)
    link.setblocking(False)
    begin, tick = time.monotonic(), 0
    while tick * PERIOD < seconds:
        time.sleep(max(begin + tick * PERIOD - time.monotonic(), 0.0))
        position = next_position(time.time())
        stamp = time.time_ns()  # when the arm gets it, on the clock of the sensor's stamps
        # ... give `position` to the arm here ...
        line = json.dumps({"t_ns": stamp, "command": position})
        with contextlib.suppress(OSError):  # the robot must go on
            link.sendto(line.encode(), place)
        tick += 1


if __name__ == "__main__":
    main()

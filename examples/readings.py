"""A sensor's loop that sends each measurement to pumafuse; to copy.

    python examples/readings.py HOST PORT [SECONDS]

A hundred times a second the sensor is read. The measurement goes as a datagram to `pumafuse live udp://...`, under the
sensor's name in fusion.toml. Axes that it does not measure are left out.
"""

import contextlib
import json
import math
import random
import socket
import sys
import time

SENSOR, PERIOD = "tracker", 0.01  # its name in fusion.toml, s


def read_sensor(t: float) -> dict[str, float]:
    """The measurement at a time [s], in mm or degrees by axis: here where commands.py was 0.1 s ago, with noise."""
    place = {"x": 560.0 + 20.0 * math.sin(0.2 * math.pi * (t - 0.1)), "y": 0.0, "z": -100.0}
    return {axis: position + random.gauss(0.0, 0.05) for axis, position in place.items()}


def main() -> None:
    """Send measurements until the time is up, or for ever."""
    seconds = float(sys.argv[3]) if len(sys.argv) > 3 else math.inf
    family, _, _, _, place = socket.getaddrinfo(sys.argv[1], sys.argv[2], type=socket.SOCK_DGRAM)[0]
    link = socket.socket(family, socket.SOCK_DGRAM)
    link.setblocking(False)
    begin, row = time.monotonic(), 0
    while row * PERIOD < seconds:
        time.sleep(max(begin + row * PERIOD - time.monotonic(), 0.0))
        measurement = read_sensor(time.time())
        stamp = time.time_ns()  # when it arrives; it is valid latency_ms of fusion.toml before
        line = json.dumps({"t_ns": stamp, "sensor": SENSOR, **measurement})
        with contextlib.suppress(OSError):  # the next one may get through
            link.sendto(line.encode(), place)
        row += 1


if __name__ == "__main__":
    main()

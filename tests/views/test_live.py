"""The live view: what its process draws into a real server; whatever becomes of it, the stream goes on."""

import contextlib
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import pumafuse as pf
import turning
from pumafuse.fusion.placing import add_tool
from pumafuse.live.stream import Stream
from pumafuse.live.wire import Event
from pumafuse.views import colours, live_viewer
from pumafuse.views import live as live_view
from pumafuse.views.live import LiveView
from recordings import columns, series

AXES = ("tangential", "radial", "vertical")
SENSORS = {
    "tracker": pf.Sensor(sd=5e-5, latency=0.008),
    "range": pf.Sensor(sd=3e-4, scale=-1.0, bias_sd=1.0, gate=0.0),
}
CONFIG = pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), sensors=SENSORS)
LONGEST = 30.0  # s until a test gives up


def own_ports(patch: pytest.MonkeyPatch) -> None:
    for name in ("PORT", "WEB_PORT"):
        patch.setattr(live_view, name, live_viewer._free(0))


@pytest.fixture(autouse=True)
def ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test asks for ports of its own."""
    own_ports(monkeypatch)


def until(there: Callable[[], object]) -> None:
    deadline = time.monotonic() + LONGEST
    while not there():
        assert time.monotonic() < deadline, "never happened"
        time.sleep(0.02)


class Driven:
    """A live estimator with a view of it, fed with commands that hold."""

    def __init__(self, mode: str, config: pf.FusionConfig = CONFIG) -> None:
        self.notices: list[str] = []
        self.live = pf.LiveEstimator(config)
        self.view = LiveView(mode, config, self.notices.append)
        self.step = 0

    def event(self, event: Event) -> None:
        feed = self.live.measurement if event.sensor else self.live.command
        self.view.event(event, feed(event.t, *([event.sensor] if event.sensor else []), **event.values))

    def go(self, steps: int = 1) -> None:
        """Some update periods: a command, a measurement of each sensor, an estimate."""
        for _ in range(steps):
            t = 100.0 + 0.028 * self.step
            self.event(Event(t, "", dict.fromkeys(AXES, 0.5)))
            self.view.estimate(self.live.estimate(t))
            self.event(Event(t + 0.010, "tracker", dict.fromkeys(AXES, 0.5 if self.step != 20 else 0.6)))
            self.event(Event(t + 0.012, "range", {"radial": 0.8 - 0.5}))
            self.tick()
            self.step += 1

    def tick(self) -> None:
        self.view.tick(self.live.health)

    @property
    def child(self) -> subprocess.Popen[bytes]:
        return self.view._child

    def noticed(self, words: str) -> bool:
        self.tick()
        return any(words in line for line in self.notices)


@contextlib.contextmanager
def recording(path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A server of Rerun that keeps what arrives in a file."""
    where = ["--bind", "127.0.0.1", "--port", str(live_view.PORT)]
    server = live_viewer._start([*where, "--save", str(path)], keep=False)
    try:
        until(lambda: live_viewer._listens(live_view.PORT))
        yield server
    finally:
        server.send_signal(signal.SIGCONT)
        server.kill()
        server.wait()


def alive(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    return False


def logged(path: Path, what: str) -> list[str]:
    return [one for chunk in columns(path, "/log") for one in chunk[f"TextLog:{what}"].flatten().to_pylist()]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Driven, Path]:
    """Sixty update periods, drawn into a viewer that opens late; then two faults begin and end."""
    path = tmp_path_factory.mktemp("drawn") / "arrived.rrd"
    with pytest.MonkeyPatch.context() as patch:
        own_ports(patch)
        driven = Driven("connect")
        until(lambda: driven.noticed("no viewer listens at"))
        with recording(path):
            until(lambda: driven.noticed("drawing into the viewer"))
            driven.go(60)
            health = driven.live.health()
            for faults in ((), ("sensor 'range': twice",), ("sensor 'range': twice", "commands: two senders"), ()):
                read, now = driven.view._health_read, replace(health, faults=faults)
                until(lambda read=read, now=now: driven.view.tick(lambda: now) or driven.view._health_read > read)
            until(lambda: driven.tick() or len(logged(path, "text")) == 4)
            until(lambda: len(series(path, "/radial/estimate")[0]) == 60 and len(series(path, "/nis/tracker")[0]))
            driven.view.close()  # not before all has arrived: it waits for no longer than 2 s
    return driven, path


def test_a_missing_viewer_is_reported_once_and_faults_as_they_begin_and_end(drawn: tuple[Driven, Path]) -> None:
    """The first viewer that opens is drawn into. Each fault once with its time: a warning, and that it is over."""
    driven, path = drawn
    assert sum("no viewer" in line for line in driven.notices) == 1
    said = ["sensor 'range': twice", "commands: two senders"]
    assert logged(path, "text") == [*said, *(f"no longer: {one}" for one in said)]
    assert logged(path, "level") == ["WARN", "WARN", "INFO", "INFO"]


def test_events_and_estimates_arrive(drawn: tuple[Driven, Path]) -> None:
    """In mm, at seconds since the first event: commands, estimates, measurements at their valid times, one rejected."""
    driven, path = drawn
    time_, value = series(path, "/radial/command")
    assert np.allclose(time_, 0.028 * np.arange(60), atol=1e-6)
    assert np.allclose(value, 500.0)
    variance = (1e3 * driven.live.estimate(100.0 + 0.028 * 59)["radial"].position_sd) ** 2
    for entity in ("/radial/estimate", "/residual/radial/estimate"):
        assert np.isclose(series(path, entity, "variances")[1][-1], variance, rtol=1e-6)
    assert not series(path, "/residual/radial/estimate")[1].any()
    time_, value = series(path, "/vertical/tracker")
    assert np.allclose(time_, np.delete(0.002 + 0.028 * np.arange(59), 20), atol=1e-6)
    assert np.allclose(value, 500.0)
    time_, value = series(path, "/vertical/tracker/rejected")
    assert np.allclose(time_, 0.002 + 0.028 * 20, atol=1e-6)
    assert np.all(value > 500.0) and np.all(value < 510.0)  # at the edge of the plot
    assert np.allclose(series(path, "/radial/range")[1], 500.0, atol=0.5)
    assert np.all(np.abs(series(path, "/residual/radial/range")[1]) < 0.5)


def test_the_estimators_process_does_not_load_rerun() -> None:
    """It is slow to load, and what draws is another process."""
    code = "import sys, pumafuse.views.live; sys.exit(bool({'rerun', 'rerun_bindings'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def newest(path: Path, entity: str, component: str, *, static: bool = False) -> np.ndarray:
    """The last value of a component, (n, …), once there is one: what has arrived may not be in the file yet."""
    found = list[Any]()
    until(
        lambda: (
            found.extend(one[component] for one in columns(path, entity, static=static) if component in one) or found
        )
    )
    return np.array(found[-1].to_pylist()[-1])


@pytest.mark.long
def test_a_tool_that_turns_is_drawn_as_of_a_recorded_result(tmp_path: Path) -> None:
    """Its newest pose, its ellipsoid of 95 % ten times as large, the camera in the cell and its marker on the tool.

    Measurements lie at frame · z − R · marker with R of the same row; one that was rejected is red.
    """
    config = add_tool(pf.FusionConfig.load(turning.configured(tmp_path)), turning.recorded())
    camera = msgspec.structs.replace(config.sensors["camera"], gate=8.0)
    config = msgspec.structs.replace(config, sensors={"camera": camera})
    given = turning.sources()
    given["camera"] = tuple(one[:290] for one in given["camera"])  # a path has 300 points; more would be thinned out
    given["camera"][1][200] += 0.1
    events = [
        Event(float(t), "" if name == "command" else name, dict(zip("xyz", point, strict=True)) | {"orientation": turn})
        for name in ("command", "camera")
        for t, point, turn in zip(given[name][0], given[name][1], given[name][2].as_quat(), strict=True)
    ]
    notices, lines = list[str](), list[bytes]()
    live, view = pf.LiveEstimator(config), LiveView("connect", config, notices.append)
    path, seen = tmp_path / "arrived.rrd", "/path/measured/camera"
    with recording(path):
        until(lambda: view.tick(live.health) or any("drawing into" in line for line in notices))
        Stream(live, lines.extend, notices.append, watchers=[view]).add(sorted(events, key=lambda event: event.t))
        until(lambda: view.tick(live.health) or columns(path, seen))
        view.close()

    now = msgspec.json.decode(lines[-1])
    point, sd = (np.array([now[axis][of] for axis in "xyz"]) for of in ("position_mm", "sd_mm"))
    assert np.allclose(newest(path, "/path/tool", "Transform3D:translation")[0], point, atol=1e-3)
    turned = Rotation.from_quat(newest(path, "/path/tool", "Transform3D:quaternion")[0])
    assert (turned * Rotation.from_quat(now["q"]).inv()).magnitude() < 1e-6
    half = newest(path, "/path/uncertainty", "Transform3D:mat3x3")[0].reshape(3, 3)
    assert np.allclose(half, np.diag(10.0 * np.sqrt(chi2.ppf(0.95, 3)) * sd), rtol=1e-5)
    for place, at, placed in turning.SHOWN:
        entity = f"/path/{place}/camera"
        assert np.allclose(newest(path, entity, "Transform3D:translation", static=True), at * 1e3, atol=1e-3)
        found = Rotation.from_quat(newest(path, entity, "Transform3D:quaternion", static=True)[0])
        assert (found * placed.inv()).magnitude() < 1e-6
    away = np.linalg.norm(point - 1e3 * turning.CORNER)
    length = newest(path, "/path/sensors/camera", "TransformAxes3D:axis_length", static=True)[0]
    assert length == pytest.approx(0.15 * away, rel=0.2)  # it stood there when the first estimate came

    _, z, turn = given["camera"]
    lever = (turning.CORNER_TURNED * turn * turning.MARKER_TURNED.inv()).apply(turning.MARKER)
    wanted = 1e3 * (turning.CORNER + turning.CORNER_TURNED.apply(z) - lever)
    points = newest(path, seen, "Points3D:positions")
    nearest = np.linalg.norm(points[:, None] - wanted, axis=2)
    assert sorted(nearest.argmin(axis=1)) == list(range(290)) and nearest.min(axis=1).max() < 1e-3
    red = np.array(newest(path, seen, "Points3D:colors")) >> 8 == int(colours.REJECTED[1:], 16)
    assert nearest.argmin(axis=1)[red].tolist() == [200]


@pytest.mark.long
def test_a_drawing_process_that_stalls_holds_nothing_up() -> None:
    """Frames that do not fit into the pipe are left out and counted; the end is not waited for longer than 2 s."""
    driven = Driven("connect")
    child = driven.child
    child.send_signal(signal.SIGSTOP)

    def dropped() -> bool:
        driven.go(20)
        return driven.view.dropped > 3

    until(dropped)
    driven.view.close()
    assert child.returncode == -signal.SIGKILL


def test_the_page_speaks_with_this_machine_only() -> None:
    """Server and page listen on loopback; the page's policy lets the viewer speak with its server only.

    A second view at once finds other ports.
    """
    driven = Driven("web")
    until(lambda: driven.noticed("open http://127.0.0.1:"))
    other = Driven("web")
    until(lambda: other.noticed("open http://127.0.0.1:"))
    assert f":{live_view.WEB_PORT}/" in driven.notices[0] and f":{live_view.WEB_PORT}/" not in other.notices[0]
    other.view.close()
    drawer = psutil.Process(driven.child.pid)
    (server,) = drawer.children()
    places = [
        one.laddr.ip for process in (drawer, server) for one in process.net_connections() if one.status == "LISTEN"
    ]
    assert set(places) == {"127.0.0.1"}

    def answer(host: str, port: int) -> str:
        with socket.create_connection(("127.0.0.1", port)) as asked:
            asked.sendall(f"GET / HTTP/1.0\r\nHost: {host}:{port}\r\n\r\n".encode())
            return b"".join(iter(lambda: asked.recv(1 << 16), b"")).decode()

    page = answer("localhost", live_view.WEB_PORT)
    for port in (live_view.WEB_PORT, live_view.PORT):
        assert " 421 " not in answer("localhost", port)
        assert " 421 Misdirected Request\r\n" in answer("elsewhere.example", port)  # which is made to lead here
    assert f"connect-src 'self' http://127.0.0.1:{live_view.PORT}\r\n" in page
    assert "re_viewer.js" in page
    assert server.environ()["CI"] == "1"  # what Rerun sends no statistics with
    driven.view.close()
    until(lambda: not any(map(alive, (drawer, server))))


def test_nothing_is_left_when_the_estimator_is_killed() -> None:
    """Its end of the pipe closes, and with it all that was started."""
    code = (
        "import time, pumafuse as pf; from pumafuse.views import live as v\n"
        "v.PORT, v.WEB_PORT = 0, 0\n"
        "config = pf.FusionConfig(arm=pf.ArmModel.load('puma560-internal'))\n"
        "view, live = v.LiveView('web', config, print), pf.LiveEstimator(config)\n"
        "while True: time.sleep(0.05); view.tick(live.health)\n"
    )
    with subprocess.Popen([sys.executable, "-u", "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        try:
            assert any("http://" in notice for notice in parent.stdout)  # it is there
            left = psutil.Process(parent.pid).children(recursive=True)
        finally:
            parent.kill()
    assert len(left) == 2
    until(lambda: not any(map(alive, left)))

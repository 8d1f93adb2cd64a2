"""A stream written down while it comes: a recorded run at any moment, and the very run that the estimator believed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.live import record
from pumafuse.live.record import Recorder
from pumafuse.live.stream import Stream
from pumafuse.logs.frames import Cylindrical
from streams import FIELDS, TRACKED, Event, T, any_stream, delayed, events_of, feed

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


class Recorded:
    """A live estimator with a recorder, and what is said."""

    def __init__(self, folder: Path, config: pf.FusionConfig = TRACKED, start: dict[str, float] | None = None) -> None:
        self.said: list[str] = []
        self.folder = folder
        self.recorder = Recorder(folder, config, start or {}, self.said.append)
        self.live = pf.LiveEstimator(config, on_notice=self.said.append, start=start, event_log=self.recorder)

    def command(self, stamp: int, **axes: float) -> None:
        self.live.command(stamp, **axes)

    def go(self, steps: int, begin: int = 0, radial: float = 0.57) -> None:
        """Commands every 28 ms, each with a measurement 10 ms later."""
        for step in range(steps):
            self.live.command(begin + step * T, radial=radial)
            self.live.measurement(begin + step * T + 10_000_000, "tracker", radial=radial)

    def tick(self) -> None:
        """As if half a second had gone by."""
        self.recorder._due = 0.0
        self.recorder.tick(self.live.sure)

    def tick_until(self, condition: Callable[[], bool]) -> None:
        give_up = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < give_up, self.said
            self.tick()
            time.sleep(0.01)

    def close(self) -> None:
        self.recorder.close(self.live.sure)


def in_mm(event: Event) -> Event:
    """The event as it is when its positions have come as mm."""
    return event._replace(values={axis: value * 1e3 / 1e3 for axis, value in event.values.items()})


def test_a_recorded_stream_fuses_to_what_was_said(tmp_path: Path) -> None:
    """The shipped run as lines: every estimate that went out is, to the last bit, that of the record as live."""
    data = files("pumafuse") / "data"
    run, config = pf.Run.read(str(data / "scan1")), pf.FusionConfig.load(str(data / "fusion.toml"))
    recorded, written = Recorded(tmp_path / "record", config, dict(run.start)), list[bytes]()
    stream = Stream(recorded.live, written.extend, recorded.said.append)
    for stamp, sensor, values in events_of(run):
        body = {axis: value * 1e3 for axis, value in values.items()}
        named = {"sensor": sensor, **body} if sensor else {"command": body}
        stream.take([json.dumps({"t_ns": stamp, **named}).encode()])
        recorded.tick()
    recorded.close()
    found = pf.Run.read(recorded.folder)
    assert found.notes == ()
    offline = pf.fuse(found, config, as_live=True)
    told = [json.loads(line) for line in written]
    for axis, track in offline.axes.items():
        assert [one[axis]["position_mm"] for one in told] == (track.position * 1e3).tolist()
        assert [one[axis]["sd_mm"] for one in told] == (track.position_sd * 1e3).tolist()


@settings(max_examples=25, deadline=None)
@given(drawn=any_stream())
def test_what_was_recorded_fuses_to_what_live_said(tmp_path_factory, drawn) -> None:
    """Any axes, gaps, repeated commands, in a random order of arrival: the record gives live's last estimates."""
    config, run, seed = drawn
    start = dict.fromkeys(run.axes, 0.5)  # else an axis that is first commanded late differs, as documented
    recorded = Recorded(tmp_path_factory.mktemp("live") / "record", config, start)
    for event in delayed(events_of(run), 0.3, seed, twice=0.1):
        feed(recorded.live, in_mm(event))
        recorded.tick()
    recorded.close()
    offline = pf.fuse(pf.Run.read(recorded.folder), config)
    last = recorded.live.estimate(offline.origin + round(offline.time[-1] * 1e9))
    for axis, track in offline.axes.items():
        assert [getattr(track, field)[-1] for field in FIELDS] == list(last[axis])


def test_it_can_be_read_while_it_grows(tmp_path: Path) -> None:
    """From the first command on there is a run, and each half second there is more of it; a late sensor joins."""
    recorded = Recorded(tmp_path / "record")
    recorded.live.measurement(0, "tracker", radial=0.57)
    recorded.tick()
    assert list(recorded.folder.iterdir()) == []
    counts = []
    for begin in range(3):
        for step in range(10):
            recorded.live.command((begin * 10 + step) * T, radial=0.57)
            if begin:
                recorded.live.measurement((begin * 10 + step) * T, "tracker", radial=0.57)
        due = 20 * begin + 11
        recorded.tick_until(lambda due=due: recorded.recorder._writer.rows == due)
        found = pf.Run.read(recorded.folder)
        counts.append((len(found.command.stamp), {name: len(source.stamp) for name, source in found.sensors.items()}))
        pf.fuse(found, TRACKED)
    recorded.close()
    assert counts == [(10, {"tracker": 1}), (20, {"tracker": 11}), (30, {"tracker": 21})]


def test_what_the_estimator_does_not_believe_is_not_recorded(tmp_path: Path) -> None:
    """A command half an hour ahead that is taken back, stamps of another year, and unknown names leave no row."""
    recorded = Recorded(tmp_path / "record")
    recorded.go(100)
    recorded.command(1800 * 10**9, radial=0.6, vertical=0.1)
    recorded.tick()  # it is in doubt, and waits
    recorded.live.measurement(10**18, "tracker", radial=0.57)
    recorded.live.measurement(100 * T, "lidar", radial=0.57)
    recorded.live.measurement(100 * T, "tracker", azimuth=0.57)
    recorded.go(100, begin=100 * T)
    later = 66_000  # ticks: after a pause over which the time of the wrong command goes by
    recorded.go(100, begin=later * T)
    recorded.close()
    found = pf.Run.read(recorded.folder)
    assert found.command.stamp.tolist() == [step * T for step in (*range(200), *range(later, later + 100))]
    assert found.axes == ("radial",)
    assert found.sensors["tracker"].stamp.max() < (later + 100) * T
    assert any("taken back" in text for text in recorded.said)


def test_a_clock_set_anew_begins_another_record(tmp_path: Path) -> None:
    """A recorded run has one clock: what comes on another one is a run beside it, and both fuse; no row is lost."""
    recorded = Recorded(tmp_path / "record")
    recorded.go(100, begin=50_000 * T)
    recorded.go(80)
    recorded.close()
    first, second = pf.Run.read(recorded.folder), pf.Run.read(tmp_path / "record.2")
    assert [len(run.command.stamp) for run in (first, second)] == [100, 80]
    assert len(first.sensors["tracker"].stamp) == 100
    assert len(second.sensors["tracker"].stamp) >= 78
    last = recorded.live.estimate(79 * T)["radial"]
    assert pf.fuse(second, TRACKED)["radial"].position[-1] == last.position
    assert any("record.2" in text for text in recorded.said)


def test_what_is_there_already_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock set anew while the next folder's name is taken, recording into the folder one is in: another number."""
    (tmp_path / "record.2").mkdir()
    (tmp_path / "record.2" / "commands.csv").write_text("mine")
    (tmp_path / "record").mkdir()
    monkeypatch.chdir(tmp_path / "record")
    recorded = Recorded(Path())
    recorded.go(100, begin=50_000 * T)
    recorded.go(80)
    recorded.close()
    assert (tmp_path / "record.2" / "commands.csv").read_text() == "mine"
    runs = [pf.Run.read(tmp_path / name) for name in ("record", "record.3")]
    assert [len(run.command.stamp) for run in runs] == [100, 80]


def test_an_axis_without_a_number_is_none_of_the_run(tmp_path: Path) -> None:
    """Commands and measurements whose other axis is always null: a run of one axis, which fuses."""
    recorded = Recorded(tmp_path / "record")
    recorded.live.measurement(0, "tracker", radial=np.nan)
    for step in range(50):
        recorded.command(step * T, radial=0.57, vertical=np.nan)
        recorded.live.measurement(step * T + 10_000_000, "tracker", radial=0.57, vertical=np.nan)
        recorded.live.measurement(step * T + 10_000_001, "tracker", radial=np.nan)
    recorded.close()
    found = pf.Run.read(recorded.folder)
    assert found.axes == ("radial",)
    assert len(found.sensors["tracker"].stamp) == 100  # that it saw nothing is a row, too
    pf.fuse(found, TRACKED)


def test_a_header_is_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is full from the first byte on, and a folder removed before it has room again."""
    monkeypatch.setattr(record, "_TRIED_AGAIN", 0.01)
    recorded, write = Recorded(tmp_path / "record"), os.write

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    recorded.go(10)
    recorded.tick_until(lambda: any("No space" in text for text in recorded.said))
    shutil.rmtree(recorded.folder)
    monkeypatch.setattr(os, "write", write)
    recorded.tick_until(lambda: recorded.recorder._writer.rows == 20)
    recorded.close()
    assert (recorded.folder / "commands.csv").read_text().count("time_ns") == 1
    assert pf.Run.read(recorded.folder).notes == ()


def test_a_record_of_nothing_leaves_nothing(tmp_path: Path) -> None:
    """A service that cannot start makes no folder at each try."""
    Recorded(tmp_path / "record").close()
    assert not (tmp_path / "record").exists()


def test_rows_that_a_run_may_not_have_are_left_out_and_counted(tmp_path: Path) -> None:
    """A command 1.5 s behind its predecessors is fused live, but would be a new segment of a recorded run."""
    recorded = Recorded(tmp_path / "record")
    recorded.go(100)
    recorded.command(99 * T - 1_500_000_000 - 5_000_000, radial=0.57)
    recorded.go(10, begin=100 * T)
    recorded.close()
    assert "1 left out" in recorded.recorder.summary()
    pf.fuse(pf.Run.read(recorded.folder), TRACKED)


def test_a_cylindrical_stream_is_recorded_with_its_frame(tmp_path: Path) -> None:
    """Rows in x, y, z, and a run.toml that says where they are."""
    frame = Cylindrical(base=(0.1, 0.0), positive="clockwise")
    config = pf.FusionConfig(arm=TRACKED.arm, sensors=TRACKED.sensors, frame=frame)
    recorded = Recorded(tmp_path / "record", config)
    for step in range(50):
        recorded.command(step * T, x=0.66, y=0.001 * step, z=-0.1)
        recorded.live.measurement(step * T + 1, "tracker", x=0.66, y=0.001 * step, z=-0.1)
    recorded.close()
    found = pf.Run.read(recorded.folder)
    assert found.frame == frame
    offline = pf.fuse(found, config)
    assert offline["tangential"].position[-1] == recorded.live.estimate(49 * T)["tangential"].position


@given(
    value=st.floats(-10.0, 10.0).map(lambda mm: mm / 1e3) | st.integers(-(10**9), 10**9).map(lambda um: um / 1e3 / 1e3)
)
def test_every_float_comes_back(value: float) -> None:
    """What came as mm is read back from the record as the same float of m."""
    assert float(record._cell(value)) / 1e3 == value


def test_no_number_is_an_empty_cell() -> None:
    """NaN, infinity and text."""
    assert [record._cell(value) for value in (np.nan, np.inf, "1", None)] == [""] * 4


def test_a_full_disk_is_said_once_a_minute_and_nothing_is_written_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk takes a few bytes of a row and then nothing for a while; when it has room again all rows are there."""
    monkeypatch.setattr(record, "_TRIED_AGAIN", 0.01)
    recorded = Recorded(tmp_path / "record")
    recorded.go(10)
    recorded.tick_until(lambda: recorded.recorder._writer.rows == 20)
    room, write = [7], os.write

    def full(descriptor: int, data: bytes) -> int:
        if not room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = write(descriptor, data[: room[0]])
        room[0] -= written
        return written

    monkeypatch.setattr(os, "write", full)
    for begin in range(1, 6):
        recorded.go(10, begin=begin * 10 * T)
        recorded.tick()
    recorded.tick_until(lambda: any("No space left on device" in text for text in recorded.said))
    torn = pf.Run.read(recorded.folder)
    assert any("may be torn" in note for note in torn.notes)
    pf.fuse(torn, TRACKED)
    for _ in range(20):
        recorded.tick()
    monkeypatch.setattr(os, "write", write)
    recorded.tick_until(lambda: any("written again" in text for text in recorded.said))
    recorded.close()
    assert sum("cannot be written" in text for text in recorded.said) == 1
    assert sum("written again" in text for text in recorded.said) == 1
    found = pf.Run.read(recorded.folder)
    assert found.notes == ()
    assert found.command.stamp.tolist() == [step * T for step in range(60)]
    assert len(found.sensors["tracker"].stamp) == 60


def test_a_trouble_that_lasts_is_said_every_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, and then once a minute."""
    recorded = Recorded(tmp_path / "record")
    recorded.go(10)
    recorded.recorder._writer.trouble = "the disk is full"
    now = [1000.0]
    monkeypatch.setattr(record.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(recorded.recorder._writer, "hand_over", lambda _: True)
    for _ in range(300):
        now[0] += 0.6
        recorded.recorder.tick(recorded.live.sure)
    assert sum("the disk is full" in text for text in recorded.said) == 3
    recorded.recorder._writer.trouble = ""
    recorded.close()


def test_rows_beyond_what_may_wait_are_lost_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is away for long costs rows, not memory."""
    monkeypatch.setattr(record, "_MOST_WAITING", 1000)
    recorded = Recorded(tmp_path / "record")
    recorded.go(10)
    recorded.tick_until(lambda: recorded.recorder._writer.rows == 20)
    recorded.go(100, begin=10 * T)
    recorded.tick()
    recorded.close()
    assert "20 rows written, 200 lost" in recorded.recorder.summary()


def test_a_folder_that_goes_is_made_anew(tmp_path: Path) -> None:
    """Removed while recording: said, and from there on there is a run again."""
    recorded = Recorded(tmp_path / "record")
    recorded.go(10)
    recorded.tick_until(lambda: recorded.recorder._writer.rows == 20)
    shutil.rmtree(recorded.folder)
    recorded.go(10, begin=10 * T)
    recorded.tick_until(lambda: any("had gone" in text for text in recorded.said))
    recorded.go(10, begin=20 * T)
    recorded.close()
    found = pf.Run.read(recorded.folder)
    assert found.command.stamp.tolist() == [step * T for step in range(10, 30)]
    pf.fuse(found, TRACKED)


def test_a_parent_that_goes_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that was unmounted is not replaced by a folder of the same name on another one."""
    monkeypatch.setattr(record, "_TRIED_AGAIN", 0.01)
    disk = tmp_path / "disk"
    recorded = Recorded(disk / "record")
    recorded.go(10)
    recorded.tick_until(lambda: recorded.recorder._writer.rows == 20)
    disk.rename(tmp_path / "away")
    recorded.go(10, begin=10 * T)
    recorded.tick_until(lambda: any("cannot be written" in text for text in recorded.said))
    assert not disk.exists()
    (tmp_path / "away").rename(disk)
    recorded.tick_until(lambda: recorded.recorder._writer.rows == 40)
    recorded.close()
    assert pf.Run.read(recorded.folder).command.stamp.tolist() == [step * T for step in range(20)]


def test_only_an_empty_folder_is_recorded_into(tmp_path: Path) -> None:
    """What is there already is never mixed with what comes."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(pf.PumafuseError, match="not empty"):
        Recorder(tmp_path, TRACKED, {}, print)
    sensors = {"../tracker": pf.Sensor(sd=1e-4)}
    with pytest.raises(pf.RunError, match=r"\.\./tracker"):
        Recorder(tmp_path / "new", pf.FusionConfig(arm=TRACKED.arm, sensors=sensors), {}, print)
    assert not (tmp_path / "new").exists()

"""A stream written down while it comes: a recorded run at any moment, and the very run that the estimator believed."""

import errno
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.live import record
from pumafuse.live.record import Recorder
from pumafuse.live.stream import Stream
from streams import FIELDS, TRACKED, Event, T, any_stream, delayed, events_of

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


class Recorded:
    """A live estimator with a recorder, and its notices."""

    def __init__(self, folder: Path, config: pf.FusionConfig = TRACKED, start: dict[str, float] | None = None) -> None:
        self.notices: list[str] = []
        self.folder = folder
        self.recorder = Recorder(folder, config, start or {}, self.notices.append)
        self.live = pf.LiveEstimator(config, on_notice=self.notices.append, start=start, event_log=self.recorder)

    def go(self, steps: int, begin: int = 0) -> None:
        """Commands every 28 ms, each with a measurement 10 ms later."""
        for step in range(begin, begin + steps):
            self.live.command(step * T, radial=0.57)
            self.live.measurement(step * T + 10_000_000, "tracker", radial=0.57)

    def tick(self) -> None:
        """As if half a second had gone by."""
        self.recorder._due = 0.0
        self.recorder.tick(self.live.sure)

    def tick_until(self, condition: Callable[[], bool]) -> None:
        give_up = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < give_up, self.notices
            self.tick()
            time.sleep(0.01)

    def written(self, rows: int) -> None:
        """Wait until so many rows are written."""
        self.tick_until(lambda: self.recorder._writer.rows == rows)

    def noticed(self, text: str) -> None:
        self.tick_until(lambda: any(text in notice for notice in self.notices))

    def close(self) -> pf.Run:
        self.recorder.close(self.live.sure)
        return pf.Run.read(self.folder)


@pytest.fixture
def recorded(tmp_path: Path) -> Recorded:
    return Recorded(tmp_path / "record")


class Kept:
    """Keeps the estimates that go out, by stamp."""

    def __init__(self) -> None:
        self.estimates = dict[int, pf.LiveEstimate]()

    def event(self, event: object, result: pf.UpdateResult) -> None: ...

    def estimate(self, estimate: pf.LiveEstimate) -> None:
        self.estimates[estimate.stamp] = estimate

    def tick(self, health: object) -> None: ...


def record_says_what_live_said(
    folder: Path, config: pf.FusionConfig, start: dict[str, float], arrivals: Sequence[Event], rate: float | None = None
) -> None:
    """Assert that what goes out while events come is, to the bit, what their record gives as live."""
    recorded, kept = Recorded(folder, config, start), Kept()
    stream = Stream(recorded.live, lambda _: None, lambda _: None, rate, [kept])
    for event in arrivals:
        stream.add([event])
        recorded.tick()
    stream.end()
    offline = pf.fuse(recorded.close(), config, mode="as-live", rate=rate)
    stamps = offline.origin + np.rint(offline.time * 1e9).astype(np.int64)
    assert sorted(kept.estimates) == stamps.tolist()
    for axis, track in offline.axes.items():
        for field in FIELDS:
            said = [getattr(kept.estimates[stamp][axis], field) for stamp in stamps.tolist()]
            assert np.array_equal(said, getattr(track, field), equal_nan=True), (axis, field)


@settings(max_examples=20)
@given(drawn=any_stream(), rate=st.sampled_from([None, 100.0]))
def test_a_record_of_any_late_rows_is_as_live(tmp_path_factory, drawn, rate) -> None:
    """Any axes, gaps and gates, sensors late by up to 0.9 s; commands too, and twice, if they are a period apart.

    Each command, and a grid.
    """
    config, run, seed = drawn
    assume((np.diff(run.command.stamp) > 0).all())  # of one stamp the last command counts
    start, rng, events = dict.fromkeys(run.axes, 0.5), np.random.default_rng(seed), events_of(run)
    apart = np.diff(run.command.stamp).min(initial=T) >= T
    first = next(event for event in events if not event.sensor)
    late = [event.stamp + (rng.uniform(0.0, 0.9e9) if event.sensor or apart else 0.0) for event in events]
    arrivals = [events[place] for place in np.argsort(late, kind="stable")]
    if apart:
        arrivals = [first, *(event for event in delayed(arrivals, 0.9, seed, twice=0.1) if event.stamp != first.stamp)]
    record_says_what_live_said(tmp_path_factory.mktemp("live") / "record", config, start, arrivals, rate)


def test_rows_that_tell_nothing_go_on_with_the_grid_as_in_their_record(tmp_path: Path) -> None:
    """One that gives no axis waits for the next; the grid ends with the last row, even if that is not used."""
    events = [
        event
        for step in range(20)
        for event in (
            Event(step * T, "", {"radial": 0.5 + 1e-3 * step}),
            Event(step * T + 21_000_000, "tracker", {"noise": 4.0}),
            Event(step * T + 2_000_000, "tracker", {"radial": 0.5}),
        )
    ]
    events.append(Event(19 * T + 90_000_000, "tracker", {"radial": float("nan")}))
    record_says_what_live_said(tmp_path / "record", TRACKED, {"radial": 0.5}, events, 100.0)


def test_a_record_without_arrivals_is_read_as_before(tmp_path: Path) -> None:
    """Those of earlier versions: each row has come at its stamp, and where rows came in order nothing changes."""
    recorded = Recorded(tmp_path / "record")
    recorded.go(60)
    now = pf.fuse(recorded.close(), TRACKED, mode="as-live")
    manifest = tmp_path / "record" / "run.toml"
    manifest.write_text(manifest.read_text().replace('arrived = "arrived_ns"\n', ""))
    run = pf.Run.read(tmp_path / "record")
    before = pf.fuse(run, TRACKED, mode="as-live")
    assert len(run.command.arrival) == 0
    for field in FIELDS:
        assert getattr(now["radial"], field).tolist() == getattr(before["radial"], field).tolist()


def test_it_can_be_read_while_it_grows(recorded: Recorded) -> None:
    """From the first command on there is a run, and each half second there is more of it; a late sensor joins."""
    recorded.live.measurement(0, "tracker", radial=0.57)
    recorded.tick()
    assert list(recorded.folder.iterdir()) == []
    counts = []
    for begin in range(3):
        for step in range(10):
            recorded.live.command((begin * 10 + step) * T, radial=0.57)
            if begin:
                recorded.live.measurement((begin * 10 + step) * T, "tracker", radial=0.57)
        recorded.written(20 * begin + 11)
        found = pf.Run.read(recorded.folder)
        counts.append((len(found.command.stamp), {name: len(source.stamp) for name, source in found.sensors.items()}))
        pf.fuse(found, TRACKED)
    recorded.close()
    assert counts == [(10, {"tracker": 1}), (20, {"tracker": 11}), (30, {"tracker": 21})]


def test_what_the_estimator_does_not_accept_is_not_recorded(recorded: Recorded) -> None:
    """A command half an hour ahead that is taken back, stamps of another year, and unknown names leave no row."""
    recorded.go(100)
    recorded.live.command(1800 * 10**9, radial=0.6, vertical=0.1)
    recorded.tick()  # it is in doubt, and waits
    recorded.live.measurement(10**18, "tracker", radial=0.57)
    recorded.live.measurement(100 * T, "lidar", radial=0.57)
    recorded.live.measurement(100 * T, "tracker", azimuth=0.57)
    recorded.go(100, begin=100)
    later = 66_000  # ticks: after a pause over which the time of the wrong command goes by
    recorded.go(100, begin=later)
    found = recorded.close()
    assert found.command.stamp.tolist() == [step * T for step in (*range(200), *range(later, later + 100))]
    assert found.axes == ("radial",)
    assert found.sensors["tracker"].stamp.max() < (later + 100) * T
    assert any("taken back" in text for text in recorded.notices)


def test_a_reset_clock_begins_another_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorded run has one clock: what comes on another one is a run beside it, under a name that is free."""
    (tmp_path / "record.2").mkdir()
    (tmp_path / "record.2" / "commands.csv").write_text("mine")
    (tmp_path / "record").mkdir()
    monkeypatch.chdir(tmp_path / "record")
    recorded = Recorded(Path())  # the folder one is in has no name of its own
    recorded.go(100, begin=50_000)
    recorded.go(80)
    recorded.close()
    first, second = pf.Run.read(tmp_path / "record"), pf.Run.read(tmp_path / "record.3")
    assert [len(run.command.stamp) for run in (first, second)] == [100, 80]
    assert len(first.sensors["tracker"].stamp) == 100
    assert len(second.sensors["tracker"].stamp) >= 78
    last = recorded.live.estimate(79 * T)["radial"]
    assert pf.fuse(second, TRACKED)["radial"].position[-1] == last.position
    assert any("record.3" in text for text in recorded.notices)
    assert (tmp_path / "record.2" / "commands.csv").read_text() == "mine"


def test_a_full_disk_is_reported_and_nothing_is_written_twice(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk takes a few bytes of a row and then nothing for a while; when it has room again all rows are there.

    A second time it is reported as soon, though less than a minute is between them.
    """
    monkeypatch.setattr(record, "_TRIED_AGAIN", 0.01)
    room, write = [0], os.write

    def nearly_full(descriptor: int, data: bytes) -> int:
        if not room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = write(descriptor, data[: room[0]])
        room[0] -= written
        return written

    def said(words: str) -> int:
        return sum(words in text for text in recorded.notices)

    for before in range(2):
        recorded.go(10, begin=20 * before)
        recorded.written(20 + 40 * before)
        room[0] = 7
        monkeypatch.setattr(os, "write", nearly_full)
        recorded.go(10, begin=20 * before + 10)
        recorded.tick_until(lambda seen=before: said("No space left on device") == seen + 1)
        pf.fuse(pf.Run.read(recorded.folder), TRACKED)
        for _ in range(20):
            recorded.tick()
        monkeypatch.setattr(os, "write", write)
        recorded.tick_until(lambda seen=before: said("written again") == seen + 1)
    found = recorded.close()
    assert said("cannot be written") == said("written again") == 2
    assert found.notes == ()
    assert found.command.stamp.tolist() == [step * T for step in range(40)]
    assert len(found.sensors["tracker"].stamp) == 40


def test_rows_beyond_what_may_wait_are_lost_and_counted(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is away for long costs rows, not memory."""
    monkeypatch.setattr(record, "_MOST_WAITING", 1000)
    recorded.go(10)
    recorded.written(20)
    recorded.go(100, begin=10)
    recorded.tick()
    recorded.close()
    assert "20 rows written, 200 lost" in recorded.recorder.summary()


def test_a_folder_that_goes_is_made_anew(recorded: Recorded) -> None:
    """Removed while recording: that is reported, and from there on there is a run again."""
    recorded.go(10)
    recorded.written(20)
    shutil.rmtree(recorded.folder)
    recorded.go(10, begin=10)
    recorded.noticed("had gone")
    recorded.go(10, begin=20)
    found = recorded.close()
    assert found.command.stamp.tolist() == [step * T for step in range(10, 30)]
    pf.fuse(found, TRACKED)


def test_only_an_empty_folder_is_recorded_into(tmp_path: Path) -> None:
    """What is there already is never mixed with what comes."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(pf.PumafuseError, match="which is not ours"):
        Recorder(tmp_path, TRACKED, {}, print)
    sensors = {"../tracker": pf.Sensor(sd=1e-4)}
    with pytest.raises(pf.RunError, match=r"\.\./tracker"):
        Recorder(tmp_path / "new", pf.FusionConfig(arm=TRACKED.arm, sensors=sensors), {}, print)
    assert not (tmp_path / "new").exists()

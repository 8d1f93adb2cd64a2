"""Clocks that are set back cut a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import RunError
from pumafuse.runs.clock import segments
from pumafuse.runs.run import Reference, Run, Source

SECOND = 1_000_000_000
TICK = 28_000_000

properties = settings(derandomize=True, deadline=None, max_examples=50)


def source(stamp: Sequence[int], label: str) -> Source:
    """A source whose values are the row numbers, so that a piece of it shows which rows it holds."""
    return Source(np.array(stamp, dtype=np.int64), {"radial": np.arange(len(stamp), dtype=float)}, label)


def recorded(command: Sequence[int], sensors: Mapping[str, Sequence[int]], truth: Sequence[int] | None = None) -> Run:
    streams = {name: source(stamp, f"{name}.csv") for name, stamp in sensors.items()}
    run = Run("run", source(command, "host.csv"), streams, start={"radial": 0.5}, notes=("torn",))
    if truth is None:
        return run
    reference = source(truth, "truth.csv")
    return replace(run, reference=Reference(reference.stamp, reference.values, reference.label, sd=1e-3))


def rows(piece: Source | None) -> list[int]:
    """Which rows of the original a piece holds."""
    assert piece is not None
    assert len(piece.stamp) == len(piece.values["radial"])
    return piece.values["radial"].astype(int).tolist()


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(RunError) as caught:
        call()
    text = str(caught.value)
    assert len(text.splitlines()) == 1, text
    return text


def cuts_by_hand(stamp: Sequence[int]) -> list[int]:
    """Rows more than 1 s behind the latest stamp since the last cut, found one row at a time."""
    cuts, latest = [], None
    for row, value in enumerate(stamp):
        if value == NO_STAMP:
            continue
        if latest is not None and latest - value > SECOND:
            cuts.append(row)
            latest = value
        latest = value if latest is None else max(latest, value)
    return cuts


def pieces_by_hand(stamp: Sequence[int]) -> list[list[int]]:
    edges = [0, *cuts_by_hand(stamp), len(stamp)]
    return [list(range(*edge)) for edge in pairwise(edges)]


def test_a_run_with_one_clock_is_one_segment() -> None:
    """Without a jump the run itself comes back and nothing is said."""
    run = recorded([0, TICK, 3600 * SECOND], {"tracker": [5, 4, 3]})
    assert segments(run) == ([run], [])


@pytest.mark.parametrize(("back", "count"), [(SECOND, 1), (SECOND + 1, 2)])
def test_a_step_back_of_one_second_is_tolerated_and_a_nanosecond_more_is_a_jump(back: int, count: int) -> None:
    """Up to 1 s rows are out of order; beyond it the clock was set back and a new segment begins."""
    stamp = [10 * SECOND, 11 * SECOND, 11 * SECOND - back, 12 * SECOND]
    parts, said = segments(recorded(stamp, {"tracker": stamp}))
    assert len(parts) == count
    assert len(said) == count - 1


def test_a_slow_slide_back_adds_up_to_a_jump() -> None:
    """What counts is how far a row is behind the latest stamp, not behind the row before it."""
    stamp = [10 * SECOND, *(10 * SECOND - step * SECOND // 2 for step in (1, 2, 3)), 20 * SECOND]
    parts, _ = segments(recorded(stamp, {}))
    assert [rows(part.command) for part in parts] == [[0, 1, 2], [3, 4]]


def test_a_jump_cuts_every_source_where_its_own_clock_jumps() -> None:
    """Each source is cut at its own row; the start level and the file's notes belong to the first segment."""
    late, early = 100 * SECOND, 50 * SECOND
    command = [late, late + TICK, early, early + TICK]
    run = recorded(command, {"tracker": [late, early, early + 1], "vision": [late, late + 1, early]}, [late, early])
    (first, second), (said,) = segments(run)
    assert [rows(part.command) for part in (first, second)] == [[0, 1], [2, 3]]
    assert [rows(part.sensors["tracker"]) for part in (first, second)] == [[0], [1, 2]]
    assert [rows(part.sensors["vision"]) for part in (first, second)] == [[0, 1], [2]]
    assert [rows(part.reference) for part in (first, second)] == [[0], [1]]
    assert [part.reference.sd for part in (first, second) if part.reference] == [1e-3, 1e-3]
    assert (first.start, second.start) == ({"radial": 0.5}, {})
    assert (first.notes, second.notes) == (("torn",), ())
    for words in ("host.csv", "50.028 s", "row 3", "new segment"):
        assert words in said


quarters = st.sampled_from([NO_STAMP, *(quarter * SECOND // 4 for quarter in range(13))])


@properties
@given(st.lists(quarters, min_size=2, max_size=20).filter(lambda stamp: max(stamp) >= 0))
def test_segments_hold_every_row_once_and_none_jumps(stamp: list[int]) -> None:
    """For any stamps the pieces are those of a walk from row to row, and together they are the whole log."""
    parts, said = segments(recorded(stamp, {"tracker": stamp}, stamp))
    wanted = pieces_by_hand(stamp)
    assert [rows(part.command) for part in parts] == wanted
    assert [rows(part.sensors["tracker"]) for part in parts] == wanted
    assert [rows(part.reference) for part in parts] == wanted
    assert len(said) == len(wanted) - 1


@pytest.mark.parametrize("truth", [None, [9 * SECOND, 0]])
def test_a_clock_that_is_set_back_for_the_commands_only_is_refused(truth: list[int] | None) -> None:
    """If a sensor's clock did not jump with the commands', nothing tells which readings belong where."""
    text = refusal(lambda: segments(recorded([9 * SECOND, 0, TICK], {"tracker": [9 * SECOND, 10 * SECOND]}, truth)))
    for words in ("host.csv", "row 2", "tracker.csv", "cut the log"):
        assert words in text


def test_a_clock_that_is_set_back_for_the_commands_and_not_the_reference_is_refused() -> None:
    """A reference counts as a source: it must jump with the commands, and is named by its file."""
    text = refusal(lambda: segments(recorded([9 * SECOND, 0], {"tracker": [9 * SECOND, 0]}, [0, SECOND])))
    for words in ("host.csv", "row 2", "truth.csv"):
        assert words in text


def test_a_sensor_may_be_called_reference() -> None:
    """A sensor's name is its own affair: one called reference is cut like the others, with and without a truth."""
    stamp = [100 * SECOND, 0]
    for truth in (None, stamp):
        parts, _ = segments(recorded(stamp, {"reference": stamp, "tracker": stamp}, truth))
        for index, part in enumerate(parts):
            assert {name: rows(piece) for name, piece in part.sensors.items()} == {
                "reference": [index],
                "tracker": [index],
            }
            assert (part.reference is None) == (truth is None)
        assert len(parts) == 2


def test_stamps_as_far_apart_as_they_may_be_are_a_jump() -> None:
    """From one end of what is read to the other the clock is set back by 292 years: no difference overflows."""
    last = 4_599_999_999 * SECOND
    run = Run.from_arrays([last, -last], {"radial": [0.0, 1.0]})
    parts, (said,) = segments(run)
    assert [part.command.stamp.tolist() for part in parts] == [[last], [-last]]
    assert "9199999998.000 s" in said


def test_a_sensor_that_is_set_back_alone_cuts_nothing() -> None:
    """A sensor whose clock jumps alone stays whole: the timeline calls its rows too late."""
    run = recorded([0, TICK], {"tracker": [9 * SECOND, 0, SECOND]})
    assert segments(run) == ([run], [])


def test_stamps_that_are_no_clock_are_refused() -> None:
    """Nonsense stamps would be a thousand segments: refused by the file's name instead."""
    nonsense = np.random.default_rng(0).integers(0, 1000 * SECOND, 1000).tolist()
    assert "host.csv" in refusal(lambda: segments(recorded(nonsense, {"tracker": nonsense})))

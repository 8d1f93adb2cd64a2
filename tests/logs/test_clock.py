"""Clocks that are set back cut a run."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import RunError
from pumafuse.logs.clock import segments, stray_offsets, without_strays
from pumafuse.logs.run import Run
from pumafuse.logs.source import Source
from refusals import one_line

SECOND = 1_000_000_000
TICK = 28_000_000

properties = settings(max_examples=50)


def source(stamp: Sequence[int], label: str) -> Source:
    """A source whose values are the row numbers, so that a piece of it shows which rows it holds."""
    return Source(np.array(stamp, dtype=np.int64), {"radial": np.arange(len(stamp), dtype=float)}, label)


def recorded(
    command: Sequence[int], sensors: Mapping[str, Sequence[int]], reference_stamp: Sequence[int] | None = None
) -> Run:
    streams = {name: source(stamp, f"{name}.csv") for name, stamp in sensors.items()}
    run = Run("run", source(command, "host.csv"), streams, start={"radial": 0.5}, notes=("torn",))
    if reference_stamp is None:
        return run
    return replace(run, reference=replace(source(reference_stamp, "truth.csv"), sd=1e-3))


def rows(piece: Source | None) -> list[int]:
    assert len(piece.stamp) == len(piece.values["radial"])
    return piece.values["radial"].astype(int).tolist()


refusal = partial(one_line, RunError)


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


def strays_by_hand(stamp: Sequence[int]) -> list[int]:
    """The stray rows, one row after the other: each is held against the last that is none and the one that follows."""
    rows = [row for row, value in enumerate(stamp) if value != NO_STAMP]
    apart = [False] * len(rows)
    regular: list[int] = []
    at = 0
    while at < len(rows):
        count = next((count for count in (1, 2) if contradicted(stamp, regular, rows[at:], count)), 0)
        apart[at : at + count] = [True] * count
        regular += rows[at : at + 1] if count == 0 else []
        at += max(count, 1)
    groups = "".join("x" if stray else " " for stray in apart)
    long = {place for group in re.finditer("xxx+", groups) for place in range(*group.span())}
    return [row for place, row in enumerate(rows) if apart[place] and place not in long]


def contradicted(stamp: Sequence[int], regular: Sequence[int], rows: Sequence[int], count: int) -> bool:
    """Whether the first ``count`` of ``rows`` are, by the last regular row and by what comes after them."""
    out, rest = [stamp[row] for row in rows[:count]], [stamp[row] for row in rows[count:]]
    if len(out) < count or not (regular or rest):
        return False
    before = stamp[regular[-1]] if regular else None
    if before is None:
        return len(rest) >= 3 and all(value - rest[0] > SECOND for value in out)
    if not rest:
        passed = [value for value in stamp[: regular[-1]] if value != NO_STAMP]
        return len(passed) >= 2 and all(before - value > SECOND for value in out)
    ahead = [value - before > SECOND and value - rest[0] > SECOND for value in out]
    return before - rest[0] <= SECOND and all(
        over or before - value > SECOND for over, value in zip(ahead, out, strict=True)
    )


STRAYS: dict[str, tuple[list[float | None], list[int]]] = {
    "one ahead": ([0, 1, 2, 50, 3, 4], [3]),
    "three ahead: the clock was set anew": ([0, 1, 2, 50, 51, 52, 3, 4, 5], []),
    "one ahead, one back": ([0, 1, 2, 50, -50, 3, 4], [3, 4]),
    "the first row ahead": ([50, 0, 1, 2], [0]),
    "the first row ahead of two only": ([50, 0, 1], []),
    "the last row back": ([0, 1, 2, -50], [3]),
    "the last row behind two only": ([0, 1, -50], []),
    "the clock goes back behind where it was": ([0, 1, 2, 50, -50, -49, -48], []),
    "ahead of what comes next by more": ([0, 1, 3.001, 2, 3, 4], [2]),
    "what comes next is farther behind": ([0, 1, 2, 50, 0.97, 0.98, 0.99, 2], []),
    "rows without a stamp are passed over": ([None, 0, 1, 2, None, 50, None, 3, 4], [5]),
}


@pytest.mark.parametrize("case", STRAYS)
def test_a_stray_stamp_is_one_that_the_rows_around_it_contradict(case: str) -> None:
    """One row or two that are elsewhere before the log goes on where it was; a pause and a clock set anew are none."""
    times, wanted = STRAYS[case]
    stamp = [NO_STAMP if time is None else round(time * SECOND) for time in times]
    assert np.flatnonzero(stray_offsets(np.array(stamp))).tolist() == wanted == strays_by_hand(stamp)


wild = st.builds(
    lambda steps, gone: [NO_STAMP if lost else step * SECOND // 2 for step, lost in zip(steps, gone, strict=False)],
    st.lists(st.sampled_from([0, 1, 2, 3, 4, 5, 6, 20, 40, 60]), min_size=1, max_size=14),
    st.lists(st.sampled_from([False] * 9 + [True]), min_size=14, max_size=14),
)


@settings(max_examples=300)
@given(wild)
def test_any_stamps_are_stray_as_a_walk_from_row_to_row_finds_them(stamp: list[int]) -> None:
    """Only rows near a step back are looked at; that misses none and finds no other."""
    assert np.flatnonzero(stray_offsets(np.array(stamp, dtype=np.int64))).tolist() == strays_by_hand(stamp)


def test_stray_stamps_are_taken_for_none_and_noted() -> None:
    """Stray commands lose their stamps, measurements and reference only ahead; no row is dropped, each source noted."""
    stamp = [time * SECOND for time in (0, 1, 2, 50, 3, -50, 4, 60, 5)]
    run = recorded(stamp, {"tracker": stamp}, stamp)
    kept = without_strays(run)
    assert kept.reference is not None
    lost = [
        np.flatnonzero(source.stamp == NO_STAMP).tolist()
        for source in (kept.command, kept.sensors["tracker"], kept.reference)
    ]
    assert lost == [[3, 5, 7], [3, 7], [3, 7]]
    assert rows(kept.command) == rows(kept.sensors["tracker"]) == rows(kept.reference) == list(range(9))
    torn, ahead, behind, *others = kept.notes
    assert torn == "torn"
    assert ahead.startswith("host.csv: 2 rows have a stray stamp") and ahead.endswith("(first: row 4, by 48.000 s)")
    assert behind.startswith("host.csv: 1 row has a stray stamp") and behind.endswith("(first: row 6, by 53.000 s)")
    assert [note.split(":")[0] for note in others] == ["tracker (tracker.csv)", "truth.csv"]
    assert without_strays(kept) is kept
    assert run.command.stamp.tolist() == stamp


@pytest.mark.parametrize(
    ("command", "tracker"), [([0, TICK, 3600 * SECOND], [5, 4, 3]), ([0, TICK], [9 * SECOND, 0, SECOND])]
)
def test_a_run_whose_commands_have_one_clock_is_one_segment(command: list[int], tracker: list[int]) -> None:
    """It comes back without a note; the rows of a sensor that is set back alone become too late."""
    run = recorded(command, {"tracker": tracker})
    assert segments(run) == ([replace(run, without_strays=True)], [])


def test_a_jump_cuts_every_source_where_its_own_clock_jumps() -> None:
    """Each source is cut at its own row; the start level and the file's notes belong to the first segment."""
    late, early = 100 * SECOND, 50 * SECOND
    command = [late, late + TICK, early, early + TICK]
    run = recorded(command, {"tracker": [late, early, early + 1], "vision": [late, late + 1, early]}, [late, early])
    (first, second), (note,) = segments(run)
    assert [rows(part.command) for part in (first, second)] == [[0, 1], [2, 3]]
    assert [rows(part.sensors["tracker"]) for part in (first, second)] == [[0], [1, 2]]
    assert [rows(part.sensors["vision"]) for part in (first, second)] == [[0, 1], [2]]
    assert [rows(part.reference) for part in (first, second)] == [[0], [1]]
    assert [part.reference.sd for part in (first, second) if part.reference] == [1e-3, 1e-3]
    assert (first.start, second.start) == ({"radial": 0.5}, {})
    assert (first.notes, second.notes) == (("torn",), ())
    for words in ("host.csv", "50.028 s", "row 3", "new segment"):
        assert words in note


quarters = st.sampled_from([NO_STAMP, *(quarter * SECOND // 4 for quarter in range(13))])


@properties
@given(st.lists(quarters, min_size=2, max_size=20).filter(lambda stamp: max(stamp) >= 0))
def test_segments_hold_every_row_once_and_none_jumps(stamp: list[int]) -> None:
    """For any stamps the pieces are those of a walk from row to row, and together they are the whole log."""
    kept = without_strays(recorded(stamp, {})).command.stamp.tolist()
    run = replace(recorded(kept, {"tracker": kept}, kept), without_strays=True)
    parts, notes = segments(run)
    wanted = pieces_by_hand(kept)
    assert [rows(part.command) for part in parts] == wanted
    assert [rows(part.sensors["tracker"]) for part in parts] == wanted
    assert [rows(part.reference) for part in parts] == wanted
    assert len(notes) == len(wanted) - 1


@pytest.mark.parametrize("reference_stamp", [None, [9 * SECOND, 0]])
def test_a_clock_that_is_set_back_for_the_commands_only_is_refused(reference_stamp: list[int] | None) -> None:
    """If a sensor's clock did not jump with the commands', no rule says which measurements belong where."""
    text = refusal(
        lambda: segments(recorded([9 * SECOND, 0, TICK], {"tracker": [9 * SECOND, 10 * SECOND]}, reference_stamp))
    )
    for words in ("host.csv", "row 2", "tracker.csv", "cut the log"):
        assert words in text


def test_stamps_that_are_no_clock_are_refused() -> None:
    nonsense = np.random.default_rng(0).integers(0, 1000 * SECOND, 1000).tolist()
    assert "host.csv" in refusal(lambda: segments(recorded(nonsense, {"tracker": nonsense})))

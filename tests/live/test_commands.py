"""Which command was in force when, and what the latest ones are."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.live.commands import Commands

FUSED = int(Outcome.FUSED)
START = (0.25, np.nan)
COMMANDS = st.lists(
    st.tuples(
        st.integers(-20, 20),
        st.sampled_from([(FUSED, FUSED), (FUSED, ABSENT), (ABSENT, FUSED), (int(Outcome.INVALID), FUSED)]),
        st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    ),
    max_size=60,
)


@settings(max_examples=300)
@given(COMMANDS, st.integers(5, 25), st.integers(0, 25), st.booleans())
def test_any_order_of_commands_has_the_one_that_was_in_force(
    commands: list[tuple[int, tuple[int, int], tuple[float, float]]], window: int, back: int, forgets: bool
) -> None:
    """At any instant that the window may ask for, and the latest with its step, as in a table of all that was fused.

    Of one stamp the last that came counts. What is taken back was never there.
    """
    ours, table, newest = Commands(START), [{}, {}], -20
    for stamp, codes, values in commands:
        newest = max(newest, stamp)
        stamp = max(stamp, newest - window)
        ours.add(stamp, bytes(codes), values, newest - window)
        for axis in range(2):
            if codes[axis] == FUSED:
                table[axis][stamp] = values[axis]
    if forgets:
        after = newest - window + min(back, window)
        ours.forget(after)
        table = [{stamp: value for stamp, value in one.items() if stamp <= after} for one in table]
    for axis, (one, found) in enumerate(zip(table, ours.latest(), strict=True)):
        stamps = sorted(one)
        if not stamps:
            assert found is None
            assert ours.at(axis, newest) is None
            continue
        level = START[axis] if axis == 0 else one[stamps[0]]
        before = one[stamps[-2]] if len(stamps) > 1 else level
        assert found == (stamps[-1], one[stamps[-1]], one[stamps[-1]] - before)
        for instant in range(newest - window, newest + 2):
            passed = [stamp for stamp in stamps if stamp <= instant]
            assert ours.at(axis, instant) == (one[passed[-1]] if passed else level)

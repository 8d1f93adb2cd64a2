"""Dates and times that a log has as text, in the ways in which programs write them.

A date with slashes is the only one that can be read in two ways: 3/4/2026 is the fourth of March or the third of April.
All of its column decides: a number above 12 is a day, and a log is short. Where neither tells, the month comes first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import date

import pyarrow as pa
import pyarrow.compute as pc

DATE = r"^\d{4}-\d\d-\d\d[T ]\d\d(:\d\d){1,2}([.,]\d{1,9})?([Zz]|[+-]\d\d(:?\d\d)?)?$"  # ISO 8601
ZONE = r"\d([Zz]|[+-]\d\d(:?\d\d)?)$"  # behind a time
# A time of day, or since the start: 12:34:56.789, 12:34:56:789 PM; of pandas 0 days 00:00:01.5.
ELAPSED = (
    r"^(?:(?P<days>\d{1,4}) DAYS?,? )?(?P<hours>\d{1,4}):(?P<minutes>\d\d):(?P<seconds>\d{1,9})"
    r"(?:[.,](?P<fraction>\d{1,9}))? ?(?P<half>[AP]M)?$"
)
# Other ways to write a time, and what stands for them here. With points the day comes first everywhere. MATLAB writes
# 1.5 sec, Excel minutes and seconds, 12:34.5.
_REWRITTEN = (
    (r"^(\d\d?[./]\d\d?[./])(\d\d)(,?[ T])", r"\120\2\3"),  # a year of this century
    (r"^(\d\d?)\.(\d)\.", r"\1.0\2."),
    (r"^(\d)\.(\d\d)\.", r"0\1.\2."),
    (r"^(\d\d)\.(\d\d)\.(\d{4}),?[ T]", r"\3-\2-\1 "),
    (r"^(\d{4})[/-](\d\d)[/-](\d\d)[ T/_,-]", r"\1-\2-\3 "),
    (r"^(\d{1,9}(?:\.\d{1,9})?) SEC$", r"0:00:\1"),
    (r"^(\d\d:\d\d[.,]\d{1,9})$", r"0:\1"),
    (r"(\b\d\d?:\d\d:\d\d):(\d{3,9})( ?[AP]M)?$", r"\1.\2\3"),
)
_SLASHED = r"^(?P<first>\d\d?)/(?P<second>\d\d?)/(?P<year>\d{4}),?[ T]+(?P<time>\d.*)$"
# A date in the order of ISO 8601 with hours of one digit, or of half a day.
_DATED = r"^(?P<date>\d{4}-\d\d-\d\d)[T ](?P<hours>\d\d?)(?P<rest>:\d\d:\d\d(?:[.,]\d{1,9})?) ?(?P<half>[AP]M)?$"
_NANOSECONDS = 10**9


def iso(column: pa.ChunkedArray) -> tuple[pa.ChunkedArray, str | None]:
    """A column of text with its dates as ISO 8601 writes them, in capital letters; how it read dates with slashes."""
    text = pc.utf8_upper(pc.utf8_trim_whitespace(column))
    for written, meant in _REWRITTEN:
        text = pc.replace_substring_regex(text, written, meant)
    text, note = _without_slashes(text) if pc.any(pc.match_substring_regex(text, _SLASHED)).as_py() else (text, None)
    fields = pc.extract_regex(text, _DATED)
    if fields.null_count == len(fields):
        return text, note
    day, hours, minutes, half = (pc.struct_field(fields, name) for name in ("date", "hours", "rest", "half"))
    hours = pc.utf8_lpad(_of_day(hours.cast(pa.int64()), half).cast(pa.string()), 2, "0")
    dated = pc.binary_join_element_wise(day, "T", hours, minutes, "")
    return pc.if_else(pc.is_valid(fields), dated, text), note


def durations(text: pa.ChunkedArray) -> pa.ChunkedArray:
    """Times without a date as durations [ns]; null where a cell has none."""
    fields, total = pc.extract_regex(text, ELAPSED), pa.scalar(0)
    for factor, part in ((1, "days"), (24, "hours"), (60, "minutes"), (60, "seconds"), (_NANOSECONDS, "fraction")):
        digits = pc.struct_field(fields, part)
        digits = pc.utf8_rpad(digits, 9, "0") if part == "fraction" else digits
        number = pc.if_else(pc.equal(digits, ""), "0", digits).cast(pa.int64())
        number = _of_day(number, pc.struct_field(fields, "half")) if part == "hours" else number
        total = pc.add(pc.multiply(total, factor), number)
    return total.cast(pa.duration("ns"))


def _of_day(hours: pa.ChunkedArray, half: pa.ChunkedArray) -> pa.ChunkedArray:
    """Hours of a day from those of its halves: 12:30 AM is half past midnight. Some programs write 13:00 PM."""
    afternoon = pc.and_(pc.equal(half, "PM"), pc.less(hours, 12))
    midnight = pc.and_(pc.equal(half, "AM"), pc.equal(hours, 12))
    return pc.if_else(afternoon, pc.add(hours, 12), pc.if_else(midnight, 0, hours))


def _without_slashes(text: pa.ChunkedArray) -> tuple[pa.ChunkedArray, str | None]:
    """Dates like 3/4/2026 in the order of ISO 8601, and which way they were read where both may be meant."""
    fields = pc.extract_regex(text, _SLASHED)
    first, second, year, time = (pc.struct_field(fields, name) for name in ("first", "second", "year", "time"))
    written: list[str] = pc.unique(pc.binary_join_element_wise(first, second, year, "/")).drop_null().to_pylist()
    span = {order: _span(written, order) for order in ("month", "day")}
    if math.isinf(min(span.values())):
        return text, None
    leading = min(span, key=lambda order: span[order])
    months, days = (first, second) if leading == "month" else (second, first)
    padded = (pc.utf8_lpad(part, 2, "0") for part in (months, days))
    dated = pc.binary_join_element_wise(pc.binary_join_element_wise(year, *padded, "-"), time, " ")
    both = not math.isinf(max(span.values()))
    note = f"dates like {written[0]} are read with the {leading} first" if both else None
    return pc.if_else(pc.is_valid(fields), dated, text), note


def _span(written: Sequence[str], leading: str) -> float:
    """Days from the first to the last of some dates that are written with slashes; infinite where one is none."""
    order = slice(None) if leading == "month" else slice(None, None, -1)
    try:
        parted = [[int(part) for part in date.split("/")] for date in written]
        days = [date(year, *parts[order]).toordinal() for *parts, year in parted]
    except ValueError:
        return math.inf
    return max(days) - min(days)

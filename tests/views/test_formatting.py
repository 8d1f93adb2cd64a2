"""Numbers and their intervals as text."""

import math

import pytest

from pumafuse.views.formatting import format_range


@pytest.mark.parametrize(
    ("value", "interval", "said"),
    [
        (0.08123, (0.0801, 0.0823), "81.2 (80.1 to 82.3)"),
        (0.5, (0.5, 0.5), "500.0000 (500.0000 to 500.0000)"),
        (0.08, (0.0, math.inf), "80 (0 to ∞)"),  # a time constant that nothing bounds
        (0.25, None, "250"),
    ],
)
def test_an_interval_has_two_digits_of_its_width(value: float, interval: tuple[float, float] | None, said: str) -> None:
    assert format_range(value, interval, 1e3) == said

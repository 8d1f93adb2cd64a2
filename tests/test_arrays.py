"""What all rooms know of arrays."""

import numpy as np
import pytest

from pumafuse.arrays import median


@pytest.mark.parametrize("count", [1, 2, 11, 1000])
def test_the_median_is_that_of_numpy(count: int) -> None:
    """To the bit, of few and of many, also where some are the same."""
    values = np.random.default_rng(count).normal(size=count)
    for some in (values, np.round(values, 1), np.sort(values)):
        assert median(some) == np.median(some)

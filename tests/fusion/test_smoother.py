"""The smoother against the conditional Gaussian given every measurement of the run."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.test_oracle import MODES, MS, UNDER, Case, cases, one, tame
from fusion_oracle import AxisOracle, check_estimates, check_innovations, nanoseconds
from pumafuse.errors import PumafuseWarning
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.config import FusionConfig
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.offline import fuse
from pumafuse.logs.run import Run
from pumafuse.logs.source import Source

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


def test_smoothing_does_not_reach_across_a_clock_that_was_set_back() -> None:
    """Each side is smoothed as if it were a run of its own."""
    parts = [Case(one(UNDER), seed=seed).made() for seed in (1, 2)]
    later, config = 60_000 * MS, parts[0][1]

    def joined(*sources: Source) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        stamps = np.concatenate([sources[0].stamp + later, sources[1].stamp])
        return stamps, {"radial": np.concatenate([source.values["radial"] for source in sources])}

    command = joined(*(run.command for run, _ in parts))
    tracker = joined(*(run.sensors["tracker"] for run, _ in parts))
    with pytest.warns(PumafuseWarning):
        both = fuse(Run.from_arrays(*command, {"tracker": tracker}), config, mode="smoothed")
    for number, (run, _) in enumerate(parts):
        alone, here = fuse(run, config, mode="smoothed")["radial"], both.segment == number
        np.testing.assert_array_equal(both["radial"].position[here], alone.position)
        np.testing.assert_array_equal(both["radial"].position_sd[here], alone.position_sd)


# ---- gates ----------------------------------------------------------------------------------------------------------


def check_gated(run: Run, config: FusionConfig, estimates: Estimates, mode: str) -> dict[Outcome, set[tuple[str, int]]]:
    """Estimates are those of the Gaussian without what was rejected; what re-acquired adds (ν/scale)² to the offset's.

    Returns:
        The rows with each outcome.
    """
    found = estimates.measurements
    stamps = np.rint(found.stamp * 1e9).astype(np.int64) + estimates.origin
    sources = [(found.sensors[number], run.sensors[found.sensors[number]].stamp) for number in found.sensor]
    rows = [(name, int(np.searchsorted(of, stamp))) for (name, of), stamp in zip(sources, stamps, strict=True)]
    by = {kind: {row for row, outcome in zip(rows, found.outcome, strict=True) if outcome == kind} for kind in Outcome}
    oracle = AxisOracle(run, config, "radial", leave_out=by[Outcome.REJECTED], reacquired=by[Outcome.REACQUIRED])
    check_innovations(found.where(np.isin(found.outcome, [Outcome.FUSED, Outcome.REACQUIRED])), oracle)
    check_estimates(estimates["radial"], getattr(oracle, mode)(nanoseconds(estimates)))
    return by


@settings(max_examples=30)
@given(cases(), st.sampled_from(["filtered", "smoothed"]))
def test_any_gated_run_is_fused_like_the_conditional_gaussian(case: Case, mode: str) -> None:
    """Gates narrow enough to reject and to re-acquire."""
    run, config = tame(case).made()
    config = msgspec.structs.replace(
        config, sensors={name: msgspec.structs.replace(each, gate=1.0) for name, each in config.sensors.items()}
    )
    check_gated(run, config, fuse(run, config, rate=case.rate, **MODES[mode]), mode)


# ---- the shipped scan -----------------------------------------------------------------------------------------------

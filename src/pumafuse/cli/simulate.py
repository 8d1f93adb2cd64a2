"""`pumafuse simulate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ..simulation import simulate as simulation
from ..simulation.scenario import Scenario
from .many import report_failures as tell
from .many import run_jobs as each
from .tables import console


def run(path: Path, output: Path, runs: int | None, force: bool) -> None:
    """Simulate a scenario, once into ``output`` or ``runs`` times into a folder each inside it.

    Raises:
        PumafuseError: The scenario is wrong, a folder is in the way, or at least one run failed.
    """
    scenario, out = Scenario.load(path), console(soft_wrap=True)
    if scenario.teaches:
        out.print(f"{scenario.name}: {scenario.teaches}", markup=False)
    if runs is None:
        made, runs_in = [_one(scenario, scenario.seed, output, force)], str(output)
        failed: dict[str, str] = {}
    else:
        seeds = range(scenario.seed, scenario.seed + runs)
        jobs = {f"seed-{seed}": partial(_one, scenario, seed, output / f"seed-{seed}", force) for seed in seeds}
        done, failed = each("simulating", jobs, [output / name for name in jobs])
        made, runs_in = list(done.values()), str(output / "seed-*")
    if made:
        commands, measurements, trials = (sum(counts) for counts in zip(*made, strict=True))
        counted = f"{commands} commands, {measurements} rows of measurements" + (
            f", {trials} step trials" if trials else ""
        )
        written = f"{'1 run' if len(made) == 1 else f'{len(made)} runs'}: {counted}, written to {output}"
        config = min(output.glob("**/fusion.toml"))
        out.print(f"{written}\nnext: pumafuse fuse {runs_in} -c {config} -o result", markup=False)
    tell(failed, len(made) + len(failed), str(output))


def _one(scenario: Scenario, seed: int, folder: Path, force: bool) -> tuple[int, int, int]:
    """Simulate one run and write it; how many commands, rows of measurements and step trials it has."""
    simulation.check_writable(folder, force)
    simulated = simulation.simulate(scenario, seed)
    simulation.write(simulated, folder, force)
    rows = sum(len(source.stamp) for source in simulated.run.sensors.values())
    return len(simulated.run.command.stamp), rows, 0 if simulated.trials is None else len(simulated.trials.axis)

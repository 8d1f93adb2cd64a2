"""`pumafuse simulate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ..simulation import simulate as simulation
from ..simulation.scenario import Scenario
from .many import report_failures, run_jobs
from .screen import say


def run(path: Path, output: Path, runs: int | None, force: bool) -> None:
    """Simulate a scenario, once into ``output`` or ``runs`` times into a folder each inside it."""
    scenario = Scenario.load(path)
    if scenario.teaches:
        say(f"{scenario.name}: {scenario.teaches}")
    failed: dict[str, str] = {}
    if runs is None:
        written, folders = [_simulate(scenario, scenario.seed, output, force)], output
    else:
        seeds = range(scenario.seed, scenario.seed + runs)
        jobs = {f"seed-{seed}": partial(_simulate, scenario, seed, output / f"seed-{seed}", force) for seed in seeds}
        done, failed = run_jobs("simulating", jobs, [output / name for name in jobs])
        written, folders = list(done.values()), output / "seed-*"
    if written:
        commands, rows, trials = (sum(counts) for counts in zip(*written, strict=True))
        counted = f"{commands} commands, {rows} rows of measurements" + (f", {trials} step trials" if trials else "")
        say(f"{len(written)} {'run' if len(written) == 1 else 'runs'}: {counted}, written to {output}")
        say(f"next: pumafuse fuse {folders} -c {min(output.glob('**/fusion.toml'))} -o result")
    report_failures(failed, len(written) + len(failed), output)


def _simulate(scenario: Scenario, seed: int, folder: Path, force: bool) -> tuple[int, int, int]:
    """Simulate one run and write it; return its numbers of commands, rows of measurements and step trials."""
    simulation.check_writable(folder, force)
    simulated = simulation.simulate(scenario, seed)
    simulation.write(simulated, folder, force)
    rows = sum(len(source.stamp) for source in simulated.run.sensors.values())
    trials = simulated.trials.get(simulation.TRIALS, ())
    return len(simulated.run.command.stamp), rows, len(trials)

"""Parsing of the command line. Each command is a module of its own, imported only when it runs."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Literal, TypeVar, overload

import typer

from ..errors import PumafuseError, PumafuseWarning

# With matrices of 5 by 5 the threads of a BLAS only wait for each other, ten times as long on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

N = TypeVar("N", float, float | None)

app = typer.Typer(
    name="pumafuse",
    help="Blend a robot arm's commands with measurements of external sensors into the best estimate of its position.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders with run.toml, or single tables.")]
Config = Annotated[Path, typer.Option("--config", "-c", metavar="FUSION.TOML", help="Arm, noise and sensors.")]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Estimates on an even grid; default: one a command.")]
Report = Annotated[Path | None, typer.Option(metavar="DIR", help="Also write tables and figures as one HTML page.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Force = Annotated[bool, typer.Option("--force", help="Replace an earlier result.")]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"pumafuse {version('pumafuse')}")
        raise typer.Exit


@app.callback()
def _root(  # pyright: ignore[reportUnusedFunction]
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


@app.command()
def fuse(
    runs: Runs,
    config: Config,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where the result folder goes.")],
    sensors: Annotated[
        str | None, typer.Option(metavar="A,B", help="Which sensors to use; default: all configured.")
    ] = None,
    rate: Rate = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Use later measurements too: the best estimate afterwards, no velocity.")
    ] = False,
    as_live: Annotated[bool, typer.Option("--as-live", help="Use only measurements that had arrived by then.")] = False,
    rrd: Annotated[bool, typer.Option("--rrd", help="Also write fused.rrd for the Rerun viewer.")] = False,
    figures: Annotated[bool, typer.Option("--figures", help="Also draw the run and its validation.")] = False,
    engine: Annotated[
        Literal["compiled", "filterpy"], typer.Option(help="filterpy: the slow reference, only for filtered estimates.")
    ] = "compiled",
    force: Force = False,
) -> None:
    """Fuse recorded runs: estimates, the outcome of each measurement, and a summary.

    Several runs get a folder each inside DIR.
    """
    from . import fuse as command

    if smooth and as_live:
        raise typer.BadParameter("choose one of --smooth and --as-live")
    if engine == "filterpy" and (smooth or as_live):
        raise typer.BadParameter("--engine filterpy gives filtered estimates only: without --smooth and --as-live")
    options = command.Options(
        config=config,
        output=output,
        sensors=None if sensors is None else _names(sensors),
        rate=_positive(rate, "--rate"),
        smooth=smooth,
        as_live=as_live,
        rrd=rrd,
        figures=figures,
        engine=engine,
        force=force,
    )
    command.run(runs, options)


@app.command()
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Result folders of `pumafuse fuse`.")],
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE_OR_RUN", help="A reference from elsewhere; default: each folder's own.")
    ] = None,
    json: Json = False,
) -> None:
    """Score results against a reference: RMSE, 95 % coverage, bias and mean NEES of each axis, and of its velocity."""
    from . import compare as command

    command.run(folders, reference, json)


@app.command()
def discretize(
    arm: Annotated[str, typer.Argument(metavar="ARM", help="An arm.toml, or the name of a preset.")],
    axis: Annotated[str | None, typer.Option(metavar="NAME", help="One axis; default: all.")] = None,
    period: Annotated[float | None, typer.Option(metavar="MS", help="Period; default: the arm's own.")] = None,
    json: Json = False,
) -> None:
    """Show the exact delay-augmented model of an arm: F, B, H, Q, poles and step response."""
    from . import discretize as command

    command.run(arm, axis, _positive(period, "--period"), json)


@app.command()
def simulate(
    scenario: Annotated[
        Path, typer.Argument(metavar="SCENARIO.TOML", help="The run to simulate, and the filter's configuration.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where the recorded run goes.")],
    runs: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="N runs with seeds in a row, in DIR/seed-K.")
    ] = None,
    force: Force = False,
) -> None:
    """Make a recorded run with its reference from a scenario, and the configuration of a filter for it."""
    from . import simulate as command

    command.run(scenario, output, runs, force)


@app.command()
def plan(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where the sequences go.")],
    axes: Annotated[
        str | None, typer.Option(metavar="A,B", help="Axes to step; default: the arm's, or the paper's three.")
    ] = None,
    speeds: Annotated[
        str, typer.Option(metavar="M_S,...", help="Speeds of the steps; a step is its speed times the period.")
    ] = "0.071,0.14,0.28,0.68",
    positions: Annotated[
        Path | None, typer.Option(metavar="TABLE", help="Where to step: a row a position, a column a coordinate.")
    ] = None,
    replicates: Annotated[int, typer.Option(metavar="N", min=1, help="How often each combination is tried.")] = 2,
    period: Annotated[
        float | None, typer.Option(metavar="MS", help="Update period; default: the arm's, or 28.")
    ] = None,
    hold: Annotated[float, typer.Option(metavar="S", help="How long a step is held.")] = 0.5,
    rest: Annotated[float, typer.Option(metavar="S", help="How long the arm rests before and after it.")] = 0.5,
    noise: Annotated[
        str, typer.Option(metavar="MM,...", help="Amplitudes of the white noise; empty: none.")
    ] = "4,8,14",
    noise_duration: Annotated[float, typer.Option(metavar="S", help="Of each white-noise sequence.")] = 4.2,
    arm: Annotated[
        str | None, typer.Option(metavar="ARM", help="What is known of the arm, to check the plan: arm.toml or preset.")
    ] = None,
    max_speed: Annotated[
        float | None, typer.Option(metavar="M_S", help="The arm's limit; default: the arm's validity.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of the order and of the noise.")] = 1,
    force: Force = False,
) -> None:
    """Lay out a step campaign and white noise to send to an arm, tick by tick."""
    from . import plan as command

    wanted = command.Wanted(
        axes=None if axes is None else _names(axes, "--axes"),
        speeds=_numbers(speeds, "--speeds"),
        positions=positions,
        replicates=replicates,
        period=_si(_positive(period, "--period")),
        hold=_positive(hold, "--hold"),
        rest=_positive(rest, "--rest"),
        amplitudes=tuple(_si(amplitude) for amplitude in _numbers(noise, "--noise")),
        noise_duration=_positive(noise_duration, "--noise-duration"),
        seed=seed,
    )
    command.run(output, wanted, arm, _positive(max_speed, "--max-speed"), force)


@app.command()
def identify(
    trials: Annotated[Path, typer.Argument(metavar="TRIALS", help="Folder with trials.csv and samples.csv.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="ARM.TOML", help="Where the model goes.")],
    period: Annotated[
        float | None, typer.Option(metavar="MS", help="Update period; default: step over speed, where trials agree.")
    ] = None,
    samples: Annotated[
        int | None, typer.Option(metavar="N", min=8, help="Use only N samples from each step on; default: all.")
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Read delay and gain off each trial, as published, instead of fitting.")
    ] = False,
    tolerance: Annotated[
        float, typer.Option(metavar="MM", help="RMS beyond which the model is not called valid.")
    ] = 1.0,
    report: Report = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Make a model of an arm from step trials: order, gain, delay and plant of each axis, with intervals."""
    from . import identify as command

    options = command.Options(
        output=output,
        period=_si(_positive(period, "--period")),
        samples=samples,
        paper=paper,
        tolerance=_si(_positive(tolerance, "--tolerance")),
        report=report,
        json=json,
        force=force,
    )
    command.run(trials, options)


@app.command()
def verify(
    runs: Runs,
    arm: Annotated[str, typer.Option("--arm", metavar="ARM", help="An arm.toml, or the name of a preset.")],
    sensors: Annotated[
        str | None, typer.Option(metavar="A,B", help="Compare with these; default: the reference, else every sensor.")
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(metavar="AXIS=MM", help="Level before the first command; default: the run's, else chosen by RMS."),
    ] = None,
    report: Report = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Check a model on runs that it was not made from, beside the best that a linear model could do there."""
    from . import verify as command

    levels = dict(_level(text) for text in start or ())
    command.run(runs, arm, None if sensors is None else _names(sensors), levels, report, json, force)


@app.command()
def tune(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders with run.toml, or single tables.")],
    config: Annotated[Path, typer.Option("--config", "-c", metavar="FUSION.TOML", help="What to start from.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where the tuned files go.")],
    fit: Annotated[str, typer.Option(metavar="A,B", help="What to fit: noise, delay, plant, gain, latency.")] = "noise",
    fix: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY", help="Leave this as it is: a name or part of one, as sensors.tracker; repeatable."),
    ] = None,
    trust: Annotated[
        str | None,
        typer.Option(metavar="SENSOR", help="An accurate sensor to fit the arm on; the others are fitted after it."),
    ] = None,
    validate: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Validate on this run. Default: a single run's last third.")
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="Also write report.html into DIR.")] = False,
    json: Json = False,
    force: Force = False,
) -> None:
    """Fit noise, delays, plants and latencies to recorded runs by maximum likelihood, with 95 % intervals.

    Exit code 3: done, but worse on what it was validated on.
    """
    from . import tune as command

    kinds = _names(fit, "--fit")
    fixed = [name for listed in fix or () for name in _names(listed, "--fix")]
    command.run(runs, config, output, kinds, fixed, trust, validate, report, json, force)


@app.command()
def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="stdin, udp://HOST:PORT, tcp-listen://HOST:PORT, tcp://HOST:PORT, or replay:RUN?speed=4 (speed=max:"
            " as fast as it can be).",
        ),
    ],
    config: Config,
    rate: Rate = None,
    window: Annotated[float, typer.Option(metavar="S", help="How late an event may come.")] = 2.0,
    stale_after: Annotated[
        float, typer.Option(metavar="S", help="Without a measurement for so long an axis is stale.")
    ] = 1.0,
    out: Annotated[
        str | None, typer.Option(metavar="udp://HOST:PORT", help="Send the estimates there; default: standard output.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record the stream as a run, into a new folder.")
    ] = None,
    rerun: Annotated[
        str | None, typer.Option(metavar="spawn|connect|web", help="Draw live: a new viewer, one that runs, a browser.")
    ] = None,
    status: Annotated[bool, typer.Option("--status", help="Show estimates and sensors on one live screen.")] = False,
    listen: Annotated[
        str | None, typer.Option(metavar="ADDR", help="Listen there instead of on loopback; needs --allow.")
    ] = None,
    allow: Annotated[
        list[str] | None, typer.Option(metavar="CIDR", help="Senders accepted with --listen; may be given again.")
    ] = None,
) -> None:
    """Estimate from a stream of commands and measurements, as they come.

    One JSON object a line, in mm and s. In: {"t": 12.345, "command": {"radial": 570.0}} and {"t": 12.351, "sensor":
    "tracker", "radial": 569.7}. Out: {"t": ..., "radial": {"position_mm": ..., "sd_mm": ..., "velocity_mm_s": ...}}.
    """
    from . import live as command

    if bool(listen) != bool(allow) or listen == "":
        raise typer.BadParameter("--listen ADDR and --allow CIDR go together", param_hint="--listen")
    options = command.Options(
        config=config,
        rate=_positive(rate, "--rate"),
        window=_positive(window, "--window"),
        stale_after=_positive(stale_after, "--stale-after"),
        status=status,
        out=out,
        record=record,
        rerun=rerun,
        listen=listen,
        allow=allow or [],
    )
    command.run(source, options)


@app.command()
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where the result folder goes.")] = Path(
        "demo"
    ),
    force: Force = False,
) -> None:
    """Fuse a recorded run that comes with pumafuse, score it against its reference, and draw it."""
    from . import fuse as command

    command.demo(output, force)


def main() -> None:
    """Run the command line.

    Exit codes: 0 done, 1 data or configuration is wrong, 2 usage, 3 a check asked for failed, 130 interrupted.
    """
    warnings.showwarning = _one_line
    warnings.simplefilter("always", PumafuseWarning)
    try:
        app()
    except PumafuseError as error:
        typer.echo(f"pumafuse: {error}", err=True)
        sys.exit(1)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone, and Python would report it once more at exit
        sys.exit(1)


def _one_line(message: Warning | str, category: type[Warning], *_: object) -> None:
    name = "warning" if issubclass(category, PumafuseWarning) else category.__name__
    typer.echo(f"{name}: {message}", err=True)


def _names(listed: str, option: str = "--sensors") -> list[str]:
    names = [name.strip() for name in listed.split(",") if name.strip()]
    if not names:
        raise typer.BadParameter("names nothing", param_hint=option)
    return names


def _numbers(listed: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(number) for number in listed.split(",") if number.strip())
    except ValueError:
        raise typer.BadParameter(f"expected numbers with commas between, not '{listed}'", param_hint=option) from None


def _level(text: str) -> tuple[str, float]:
    """``radial=560`` as an axis and its level [m]."""
    axis, _, level = text.partition("=")
    try:
        return axis.strip(), _si(float(level))
    except ValueError:
        raise typer.BadParameter(f"expected AXIS=MM, not '{text}'", param_hint="--start") from None


@overload
def _si(value: float) -> float: ...
@overload
def _si(value: None) -> None: ...
def _si(value: float | None) -> float | None:
    """Milliseconds or millimetres of the command line in s or m, without a binary rounding in between."""
    from ..units import shifted  # imports numpy, which no --help needs

    return None if value is None else shifted(value, -3)


def _positive(value: N, name: str) -> N:
    if value is not None and not 0.0 < value < float("inf"):
        raise typer.BadParameter(f"must be a positive number, not {value}", param_hint=name)
    return value

"""Parsing of the command line. Each command is a module of its own, imported only when it runs."""

import atexit
import gc
import os
import shlex
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, BadParameter, Option

from ..errors import PumafuseError, PumafuseWarning, printable
from .screen import say

# With matrices of 5 by 5 the threads of a BLAS only wait for each other, ten times as long on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Without `from __future__ import annotations`: typer would evaluate each of them again, a sixth of `--help`.
app = typer.Typer(
    name="pumafuse",
    help="Blend a robot arm's commands with measurements of external sensors into the best estimate of its position.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ROS_ARGS = "--ros-args"  # what is behind it is for ROS, not for typer

Runs = Annotated[list[Path], Argument(metavar="RUN...", help="Folders with run.toml, or single tables.")]
Config = Annotated[Path, Option("--config", "-c", metavar="FUSION.TOML", help="Arm, noise and sensors.")]
FoundConfig = Annotated[
    Path | None,
    Option("--config", "-c", metavar="FUSION.TOML", help="Arm, noise and sensors; default: found in the log."),
]
Rate = Annotated[float | None, Option(metavar="HZ", help="Estimates on an even grid; default: one a command.")]
From = Annotated[
    float | None, Option("--from", metavar="S", help="Begin S seconds after the first command; earlier commands count.")
]
To = Annotated[float | None, Option("--to", metavar="S", help="End S seconds after the first command.")]
Sensor = Annotated[
    str | None,
    Option(metavar="NAME", help="Whose stamps are right; default: the reference, or the sensor with the least noise."),
]
Report = Annotated[Path | None, Option(metavar="DIR", help="Also write tables and figures as one HTML page.")]
Json = Annotated[bool, Option("--json", help="Print JSON instead of a table.")]
Force = Annotated[bool, Option("--force", help="Replace an earlier result.")]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        say(f"pumafuse {version('pumafuse')}")
        raise typer.Exit


@app.callback()
def _root(  # pyright: ignore[reportUnusedFunction]
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    pass


@app.command()
def init(
    log: Annotated[Path, Argument(metavar="LOG", help="A table, MCAP, bag or .rrd, or a folder of them.")],
    output: Annotated[
        Path | None, Option("--output", "-o", metavar="DIR", help="Where the files go; default: LOG-fusion.")
    ] = None,
    rate: Annotated[float | None, Option(metavar="HZ", help="How often rows come, for tables without stamps.")] = None,
    force: Force = False,
) -> None:
    """Look at a log, list what is in it, and write run.toml, arm.toml and fusion.toml to begin with."""
    from . import init as command

    if rate is not None and not 0.0 < rate < 1e9:
        raise BadParameter("--rate is a number of rows a second, above 0")
    command.run(log, output, rate or 0.0, force)


@app.command()
def fuse(
    runs: Annotated[
        list[Path], Argument(metavar="RUN...", help="Folders with run.toml, or single tables; without -c one log.")
    ],
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Where the result folder goes.")],
    config: FoundConfig = None,
    sensors: Annotated[list[str] | None, Option(metavar="A,B", help="Which to use; default: all configured.")] = None,
    rate: Rate = None,
    smooth: Annotated[bool, Option("--smooth", help="Use later measurements too; gives no velocity.")] = False,
    as_live: Annotated[bool, Option("--as-live", help="Use only measurements that had arrived by then.")] = False,
    rrd: Annotated[bool, Option("--rrd", help="Also write fused.rrd for the Rerun viewer.")] = False,
    figures: Annotated[bool, Option("--figures", help="Also draw the run and its validation.")] = False,
    engine: Annotated[
        Literal["compiled", "filterpy"], Option(help="filterpy: the slow reference, only for filtered estimates.")
    ] = "compiled",
    since: From = None,
    until: To = None,
    force: Force = False,
    resume: Annotated[bool, Option("--resume", help="Keep results that are there already; fuse the others.")] = False,
) -> None:
    """Fuse recorded runs: estimates, the outcome of each measurement, and a summary.

    Several runs get a folder each inside DIR. Without -c a log of any kind is looked at as by `init`, and arm and noise
    are fitted to it as by `tune`.
    """
    if smooth and as_live:
        raise BadParameter("choose one of --smooth and --as-live")
    if resume and force:
        raise BadParameter("choose one of --resume and --force")
    if engine == "filterpy" and (smooth or as_live):
        raise BadParameter("--engine filterpy gives filtered estimates only: without --smooth and --as-live")
    _check_positive(rate=rate)
    mode = "smoothed" if smooth else "as-live" if as_live else "filtered"
    extras = [name for name, wanted in {"fused.rrd": rrd, "fused.png": figures}.items() if wanted]
    part = _part(since, until)
    if config is None:
        from . import from_log

        if len(runs) > 1 or resume:
            raise BadParameter("is needed for several runs, and to --resume", param_hint="--config")
        from_log.run(runs[0], output, _names(sensors), rate, mode, extras, engine, force, part)
        return
    from . import fuse as command

    command.run(runs, config, output, _names(sensors), rate, mode, extras, engine, force, part, resume)


@app.command()
def register(
    runs: Runs,
    config: FoundConfig = None,
    sensor: Annotated[str | None, Option(metavar="NAME", help="Which one; default: each that gives x, y, z.")] = None,
    fix: Annotated[list[str] | None, Option(metavar="marker,latency", help="What stays as it is.")] = None,
    output: Annotated[
        Path | None, Option("--output", "-o", metavar="DIR", help="Where fusion.toml and arm.toml go.")
    ] = None,
    json: Json = False,
    since: From = None,
    until: To = None,
    force: Force = False,
) -> None:
    """Find where a sensor stands, what it sees on the tool, and how late it is, from any motion."""
    from . import register as command

    command.run(runs, config, sensor, _names(fix) or (), output, json, force, _part(since, until))


@app.command()
def compare(
    folders: Annotated[list[Path], Argument(metavar="DIR...", help="Result folders of `pumafuse fuse`.")],
    reference: Annotated[Path | None, Option(metavar="FILE_OR_RUN", help="Default: each folder's own.")] = None,
    tum: Annotated[Path | None, Option(metavar="OUT", help="A new folder for trajectories in the TUM format.")] = None,
    json: Json = False,
    figures: Annotated[bool, Option("--figures", help="Also draw pumafuse-comparison.png, in this folder.")] = False,
) -> None:
    """Compare results, with a reference or without: errors, log-likelihood, NIS, prediction, and which one to take."""
    from . import compare as command

    command.run(folders, reference, json, tum, figures)


@app.command()
def discretize(
    arm: Annotated[str, Argument(metavar="ARM", help="An arm.toml, or the name of a preset.")],
    axis: Annotated[str | None, Option(metavar="NAME", help="One axis; default: all.")] = None,
    period: Annotated[float | None, Option(metavar="MS", help="Period; default: the arm's own.")] = None,
    json: Json = False,
) -> None:
    """Show the exact delay-augmented model of an arm: F, B, H, Q, poles and step response."""
    from . import discretize as command

    _check_positive(period=period)
    command.run(arm, axis, period, json)


@app.command()
def simulate(
    scenario: Annotated[Path, Argument(metavar="SCENARIO.TOML", help="The run, and the filter's configuration.")],
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Where the recorded run goes.")],
    runs: Annotated[int | None, Option(metavar="N", min=1, help="N runs with seeds in a row, in DIR/seed-K.")] = None,
    force: Force = False,
) -> None:
    """Make a recorded run with its reference from a scenario, and the configuration of a filter for it."""
    from . import simulate as command

    command.run(scenario, output, runs, force)


@app.command()
def identify(
    source: Annotated[
        list[Path],
        Argument(metavar="TRIALS|RUN...", help="A folder with trials.csv and samples.csv, or recorded runs."),
    ],
    output: Annotated[Path, Option("--output", "-o", metavar="ARM.TOML", help="Where the model goes.")],
    sensor: Sensor = None,
    period: Annotated[
        float | None, Option(metavar="MS", help="Of trials: update period; default: step over speed.")
    ] = None,
    samples: Annotated[
        int | None, Option(metavar="N", min=8, help="Of trials: samples used from each step on; default: all.")
    ] = None,
    paper: Annotated[
        bool, Option("--paper", help="Of trials: read delay and gain off each trial, as published.")
    ] = False,
    tolerance: Annotated[
        float | None,
        Option(
            metavar="MM",
            help="Of trials: RMS beyond which the model is not called valid, of angles in degrees; default: 1 or 0.1.",
        ),
    ] = None,
    report: Report = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Make a model of an arm from step trials or any recorded motion: order, gain, delay and plant, with intervals."""
    from . import identify as command

    _check_positive(period=period, tolerance=tolerance)
    command.run(source, output, sensor, period, samples, paper, tolerance, report, json, force)


@app.command()
def latency(
    runs: Runs,
    sensor: Sensor = None,
    since: From = None,
    until: To = None,
    report: Report = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Tell how late the arm and each sensor are, from any recorded motion, with 95 % intervals.

    Nothing has to be known of the arm.
    """
    from . import latency as command

    command.run(runs, sensor, report, json, force, _part(since, until))


@app.command()
def verify(
    runs: Runs,
    arm: Annotated[str, Option("--arm", metavar="ARM", help="An arm.toml, or the name of a preset.")],
    sensors: Annotated[list[str] | None, Option(metavar="A,B", help="Default: the reference, or all.")] = None,
    start: Annotated[
        list[str] | None,
        Option(metavar="AXIS=VALUE", help="Start level, mm or degrees; default: the run's, else chosen by RMS."),
    ] = None,
    report: Report = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Check a model on runs that it was not made from, beside the best that a linear model could do there.

    Exit code 3: done, but the model does not hold: it explains less than half of a motion.
    """
    from . import verify as command

    levels = dict(_level(text) for text in start or ())
    command.run(runs, arm, _names(sensors), levels, report, json, force)


@app.command()
def tune(
    runs: Runs,
    config: Annotated[Path, Option("--config", "-c", metavar="FUSION.TOML", help="What to start from.")],
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Where the tuned files go.")],
    fit: Annotated[
        list[str] | None,
        Option(metavar="A,B", help="What to fit: noise (default), delay, plant, gain, latency, scale, bias."),
    ] = None,
    fix: Annotated[
        list[str] | None, Option(metavar="KEY", help="Leave as it is: a name or part, as sensors.tracker; repeatable.")
    ] = None,
    share: Annotated[
        Literal["delay"] | None, Option(help="One for all axes, also where the measurements say otherwise.")
    ] = None,
    trust: Annotated[str | None, Option(metavar="SENSOR", help="Fit the arm on this accurate sensor first.")] = None,
    validate: Annotated[Path | None, Option(metavar="RUN", help="Default: a single run's last third.")] = None,
    no_sd_prior: Annotated[
        bool, Option("--no-sd-prior", help="Let a sensor's sd be any; else near what its second differences show.")
    ] = False,
    since: From = None,
    until: To = None,
    report: Annotated[bool, Option("--report", help="Also write report.html into DIR.")] = False,
    json: Json = False,
    force: Force = False,
) -> None:
    """Fit noise, delays, plants and latencies to recorded runs by maximum likelihood, with 95 % intervals.

    Exit code 3: done, but worse on what it was validated on.
    """
    from . import tune as command

    kinds, fixed = _names(fit, "--fit") or ["noise"], _names(fix, "--fix") or []
    prior, part = not no_sd_prior, _part(since, until)
    command.run(runs, config, output, kinds, fixed, share, trust, validate, prior, report, json, force, part)


@app.command()
def live(
    context: typer.Context,
    sources: Annotated[list[str], Argument(metavar="SOURCE...", help="Where events come from, see above.")],
    config: Config,
    rate: Rate = None,
    window: Annotated[float, Option(metavar="S", help="How late an event may come; at least 1 s.")] = 2.0,
    stale_after: Annotated[float, Option(metavar="S", help="Without a measurement so long an axis is stale.")] = 1.0,
    out: Annotated[str | None, Option(metavar="udp://HOST:PORT", help="Where estimates go; default: stdout.")] = None,
    record: Annotated[Path | None, Option(metavar="DIR", help="Record the stream as a run, into a new folder.")] = None,
    rerun: Annotated[
        str | None, Option(metavar="spawn|connect|web", help="Draw live: a new viewer, one that runs, a browser.")
    ] = None,
    status: Annotated[bool, Option("--status", help="Show estimates and sensors on one live screen.")] = False,
    listen: Annotated[str | None, Option(metavar="ADDR", help="Listen there, not on loopback; needs --allow.")] = None,
    allow: Annotated[list[str] | None, Option(metavar="CIDR", help="Who may send with --listen; repeatable.")] = None,
) -> None:
    """Estimate from a stream of commands and measurements, as they come.

    SOURCE is stdin, udp://HOST:PORT, tcp-listen://HOST:PORT, tcp://HOST:PORT, or a recorded run: replay:RUN?speed=4
    (speed=max: as fast as it can be). It is topics of a running ROS 2, as a run.toml names them: ros2:run.toml; then
    estimates go to topics, and --ros-args is as everywhere in ROS. Or it is the controller of a robot of Universal
    Robots, rtde:run.toml?host=HOST, or a tracker's server of OpenIGTLink, igtl://HOST. Of the network there may be
    several, with stamps of one clock.

    One JSON object a line, in s and mm (of angles degrees). In: {"t": 12.345, "command": {"x": 570.0}} and {"t": 12.35,
    "sensor": "tracker", "x": 569.7}. Out: {"t": ..., "x": {"position_mm": ..., "sd_mm": ..., "velocity_mm_s": ...}}.
    """
    from . import live as command

    if bool(listen) != bool(allow) or listen == "":
        raise BadParameter("--listen ADDR and --allow CIDR go together", param_hint="--listen")
    _check_positive(rate=rate, window=window, stale_after=stale_after)
    ros: list[str] = context.obj or []
    if ros and not any(source.startswith("ros2:") for source in sources):
        raise BadParameter("goes with a source ros2:run.toml", param_hint=ROS_ARGS)
    command.run(sources, config, rate, window, stale_after, out, record, rerun, status, listen, allow or [], ros)


@app.command()
def export(
    config: Config,
    output: Annotated[Path, Option("--output", "-o", metavar="FILTER.H", help="Where the header goes.")],
    force: Force = False,
) -> None:
    """Write a configuration as a C header, for a controller with the filter in it (pumafuse.h).

    The names in it begin with the file's: filter_model, FILTER_AXES.
    """
    from . import export as command

    command.run(config, output, force)


@app.command()
def demo(
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Where the result goes.")] = Path("demo"),
    force: Force = False,
) -> None:
    """Fuse a recorded run that comes with pumafuse, score it against its reference, and draw it."""
    from . import fuse as command

    command.demo(output, force)


def main() -> None:
    """Run the command line.

    Exit codes: 0 done, 1 data or configuration is wrong, 2 usage, 3 a check asked for failed, 70 a fault of pumafuse
    itself (sysexits.h: EX_SOFTWARE), 130 interrupted.
    """
    warnings.showwarning = _one_line
    warnings.simplefilter("once", PumafuseWarning)  # what `fuse LOG` notices while tuning, it would say again
    # What is imported stays: looking through it time and again, and once more at the end, is a quarter of `fuse`.
    gc.set_threshold(10_000, 1_000)
    atexit.register(gc.freeze)
    # After a worker was killed, joblib's process that cleans up what workers share may warn of what it finds.
    quiet = "ignore::UserWarning:joblib.externals.loky.backend.resource_tracker"
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), quiet)))
    for stop in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, stop, None)  # Windows has no SIGHUP; nohup ignores it
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _end)
    arguments = sys.argv[1:]
    end = arguments.index(ROS_ARGS) if "live" in arguments[:1] and ROS_ARGS in arguments else len(arguments)
    try:
        app(arguments[:end], obj=arguments[end:])
    except SystemExit as ended:
        if isinstance(getattr(ended.__context__, "__cause__", None), KeyboardInterrupt):  # of which typer says nothing
            say("interrupted", err=True)
        raise
    except PumafuseError as error:
        say(f"pumafuse: {error}", err=True)
        sys.exit(1)
    except MemoryError:
        say("pumafuse: not enough memory: use a part of the log, or fewer columns", err=True)
        sys.exit(1)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):  # whoever read our output has what it wanted
            say(f"pumafuse: {error.filename or 'standard output'}: {error.strerror}", err=True)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what its buffer holds would fail once more at exit
        sys.exit(1)
    except Exception as error:
        say(f"pumafuse: {_unexpected_message(error)}", err=True)
        sys.exit(70)


def _unexpected_message(error: Exception) -> str:
    """What to say of an exception that nobody foresaw: one line that tells what was being read, and where it happened.

    That is the innermost file or folder that a function was called with.
    """
    import traceback
    from importlib.metadata import version

    frames, package = list(traceback.walk_tb(error.__traceback__)), Path(__file__).parents[1]
    paths = [
        value for frame, _ in frames for value in frame.f_locals.values() if isinstance(value, Path) and value.exists()
    ]
    read = f", reading {paths[-1]}" if paths else ""
    files = [(Path(frame.f_code.co_filename), line) for frame, line in frames]
    where = [f"{file.relative_to(package)}:{line}" for file, line in files if file.is_relative_to(package)]
    return printable(
        f"{shlex.join(sys.argv[1:])}: unexpected {type(error).__name__}: {error}{read}. This is a fault of pumafuse:"
        f" please report it with this line and the log, or a part that shows it ({version('pumafuse')};"
        f" {', '.join(where)})",
        2000,
    )


def _end(number: int, _frame: object) -> None:
    """End by a signal as after an error, so that nothing half written is left."""
    sys.exit(128 + number)


def _one_line(message: Warning | str, category: type[Warning], *_: object) -> None:
    name = "warning" if issubclass(category, PumafuseWarning) else category.__name__
    say(f"{name}: {message}", err=True)


def _names(listed: list[str] | None, option: str = "--sensors") -> list[str] | None:
    """Names with commas between, of an option that may be given several times; None if it is not given."""
    names = [name.strip() for name in ",".join(listed).split(",") if name.strip()] if listed else None
    if names == []:
        raise BadParameter("names nothing", param_hint=option)
    return names


def _level(text: str) -> tuple[str, float]:
    """``x=560`` as an axis and its level, in mm or degrees."""
    axis, _, level = text.partition("=")
    try:
        return axis.strip(), float(level)
    except ValueError:
        raise BadParameter(f"expected AXIS=VALUE, not '{text}'", param_hint="--start") from None


def _part(since: float | None, until: float | None) -> tuple[float | None, float | None]:
    """The part from ``--from`` to ``--to``, which must be an interval after the first command."""
    if since is not None and not 0.0 <= since < float("inf"):
        raise BadParameter(f"must be a number of seconds after the first command, not {since}", param_hint="--from")
    if until is not None and not (since or 0.0) < until < float("inf"):
        raise BadParameter(f"must be a number of seconds after --from, not {until}", param_hint="--to")
    return since, until


def _check_positive(**options: float | None) -> None:
    """Refuse an option that is given and is no positive number."""
    for name, value in options.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise BadParameter(f"must be a positive number, not {value}", param_hint=f"--{name.replace('_', '-')}")

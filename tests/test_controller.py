"""The filter in a controller: the header of `pumafuse export`, and the loop in C to copy."""

import platform
import shutil
import subprocess
from pathlib import Path
from unittest import mock

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from executable import DATA
from pumafuse.cli import export
from pumafuse.filter.core import LIBRARY
from pumafuse.filter.window import Window
from streams import MS, Event, events_of, feed

ROOT = Path(__file__).parent.parent
COMPILER = shutil.which("cc")
TICK = MS
SECONDS = 20
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")

# Everything that a fusion.toml can say, and names that are none in C.
ARM = """
name = "two joints"
update_period_ms = 10.0
delay_ms = 30.0
[axes."1. arm"]
kind = "angle"
plant = "second-order"
natural_frequency_rad_s = 41.7
damping = 1.3
gain = { slope_s_rad = 0.07, intercept = 0.9 }
gain_recovery_ms = 90.0
max_speed_deg_s = 123.4
lag_ms_ci95 = [95.0, 105.0]
[axes."1_ arm"]
kind = "angle"
plant = "first-order"
time_constant_ms = 33.3
delay_ms = 12.3
unseen_lag_sd_ms = 4.0
play_deg = 0.7
sag = { offset_deg = 0.1, slope = -0.02, knee_deg = 33.0, slope_beyond = 0.3 }
gain = { intercept = 0.9, intercept_ci95 = [0.88, 0.93] }
"""
CONFIG = """
arm = "arm.toml"
[start]
offset_sd_deg = 0.3
[process]
input_noise_deg_rtHz = 0.003
drift_deg_rts = 0.1
disturbance_sd_deg = 0.2
disturbance_time_ms = 700.0
[process."1. arm"]
disturbance_kind = "ou"
maneuver_noise_deg_rtHz_per_deg_s = 0.011
maneuver_drift_deg_rts_per_deg_s = 0.013
[sensors."/* é */"]
sd_deg = { "1. arm" = 0.05 }
bias_sd_deg = 7.0
latency_ms = 8.1
latency_sd_ms = 0.7
gate_rows = false
scale = -1.1
turn_deg = 360.0
[sensors.int]
sd_deg = 0.03
bias_drift_sd_deg = 0.1
bias_time_s = 4.321
gate = 0.0
"""

# Counts what the whole process allocates and says it at the end.
COUNTER = """
#include <stddef.h>
#include <stdio.h>
void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t);
void *__libc_memalign(size_t, size_t);
static long calls;
void *malloc(size_t size) { calls++; return __libc_malloc(size); }
void *calloc(size_t count, size_t size) { calls++; return __libc_calloc(count, size); }
void *realloc(void *old, size_t size) { calls++; return __libc_realloc(old, size); }
void *aligned_alloc(size_t to, size_t size) { calls++; return __libc_memalign(to, size); }
__attribute__((destructor)) static void say(void) { fprintf(stderr, "%ld calls\\n", calls); }
"""


def compiled(folder: Path, *sources: Path) -> Path:
    """The program of some sources, with the header in their folder and the library that Python loads."""
    program = sources[0].with_suffix("")
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{folder}", f"-I{ROOT / 'core' / 'include'}"]
    link = [str(LIBRARY), f"-Wl,-rpath,{LIBRARY.parent}"]
    subprocess.run([str(COMPILER), *flags, "-o", str(program), *map(str, sources), *link], check=True)
    return program


def said(program: Path, lines: str) -> tuple[str, str]:
    """What a program writes to its output, and to its errors."""
    done = subprocess.run([program], input=lines, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


@pytest.fixture(scope="module", params=[False, True], ids=["as shipped", "bent"])
def folder(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """With the loop, and the shipped scan's configuration, or with a fastest speed, play and sag, as a header."""
    folder = tmp_path_factory.mktemp("controller")
    config = pf.FusionConfig.load(DATA / "scan" / "fusion.toml")
    bends = {"max_speed": 0.05, "play": 2e-4, "sag": pf.Sag(slope=-1e-3)} if request.param else {}
    axes = {name: msgspec.structs.replace(axis, **bends) for name, axis in config.arm.axes.items()}
    msgspec.structs.replace(config, arm=msgspec.structs.replace(config.arm, axes=axes)).save(folder)
    export.run(folder / "fusion.toml", folder / "filter.h", force=False)
    shutil.copy(ROOT / "examples" / "controller.c", folder)
    return folder


@pytest.fixture(scope="module")
def arrivals() -> list[tuple[int, Event]]:
    """The shipped scan's first seconds as they reach a controller.

    Its commands at once; of the measurements all are up to 50 ms late, one in ten up to 1.9 s, one in a hundred 2.5 s,
    which is more than the window, and one in twenty comes twice.
    """
    events = [one for one in events_of(pf.Run.read(DATA / "scan")) if one.stamp < SECONDS * 1000 * MS]
    rng = np.random.default_rng(1)
    found = [(one.stamp, one) for one in events if not one.sensor]
    measured = [one for one in events if one.sensor]
    for one in [*measured, *(one for one in measured if rng.random() < 0.05)]:
        chance = rng.random()
        late = 2500.0 if chance < 0.01 else rng.uniform(0.0, 1900.0 if chance < 0.1 else 50.0)
        found.append((one.stamp + round(late * MS), one))
    return sorted(found, key=lambda arrival: arrival[0])


def lines_of(arrivals: list[tuple[int, Event]]) -> str:
    """Arrivals as the loop reads them."""
    config = pf.FusionConfig.load(DATA / "scan" / "fusion.toml")
    sources = {"": -1} | {name: number for number, name in enumerate(config.sensors)}
    return "".join(
        f"{arrival} {sources[sensor]} {stamp} {' '.join(repr(values.get(axis, np.nan)) for axis in config.arm.axes)}\n"
        for arrival, (stamp, sensor, values) in arrivals
    )


def test_the_loop_knows_what_live_knows(folder: Path, arrivals: list[tuple[int, Event]]) -> None:
    """At each of twenty thousand ticks its estimates are those of Python's estimator, to the bit, and so are outcomes.

    It is fed late measurements, some too late for the window, and doubled ones.
    """
    printed, summary = said(compiled(folder, folder / "controller.c"), lines_of(arrivals))
    live = pf.LiveEstimator(pf.FusionConfig.load(folder / "fusion.toml"))
    outcomes = dict.fromkeys(pf.Outcome, 0)
    came, ticks, different = iter(arrivals), 0, []
    arrival, event = next(came)
    for tick, line in enumerate(printed.splitlines()):
        now = arrivals[0][0] + tick * TICK
        while arrival <= now:
            result = feed(live, event)
            for outcome in result.axes.values() if event.sensor else ():
                outcomes[outcome] += 1
            arrival, event = next(came, (2**63, event))
        stamp, *numbers = line.split()
        axes = live.estimate(now).axes.values()
        expected = [x for one in axes for x in (one.position, one.velocity, one.position_sd, one.velocity_sd)]
        if int(stamp) != now or list(map(float.fromhex, numbers)) != expected:
            different.append(now)
        ticks += 1
    assert arrival == 2**63
    assert ticks > SECONDS * 1000
    assert different == []
    words = {pf.Outcome.FUSED: "values fused", pf.Outcome.TOO_LATE: "too late"}
    shown = ("FUSED", "REJECTED", "REACQUIRED", "DUPLICATE", "TOO_LATE")
    told = [f"{outcomes[one]} {words.get(one, one.word)}" for one in (pf.Outcome[name] for name in shown)]
    assert summary == ", ".join(told) + "\n"
    assert min(outcomes[pf.Outcome[name]] for name in ("REJECTED", "DUPLICATE", "TOO_LATE")) > 5


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="what is counted are calls of glibc's malloc")
def test_the_loop_allocates_nothing(folder: Path, arrivals: list[tuple[int, Event]]) -> None:
    """With twenty seconds of events it calls malloc as often as without one; a window that grows is noticed."""
    counter, grows = folder / "counter.c", folder / "grows.c"
    counter.write_text(COUNTER)
    grows.write_text((folder / "controller.c").read_text().replace("ROOM, ROOM", "2, ROOM"))
    counting = folder / "counting.c"
    shutil.copy(folder / "controller.c", counting)
    programs = [compiled(folder, one, counter) for one in (counting, grows)]
    calls = [[int(said(one, lines)[1].split()[-2]) for lines in ("", lines_of(arrivals))] for one in programs]
    assert calls[0][0] == calls[0][1] > 4096  # a checkpoint for each event
    assert calls[1][0] < calls[1][1]


def test_the_header_has_the_numbers_that_live_has(tmp_path: Path) -> None:
    """Every number of every struct, as a compiler reads it: NaN, unused sensors, biases; and each name its place."""
    (tmp_path / "arm.toml").write_text(ARM)
    (tmp_path / "fusion.toml").write_text(CONFIG)
    export.run(tmp_path / "fusion.toml", tmp_path / "6 dof.h", force=False)
    source = tmp_path / "dump.c"
    source.write_text("""
        #include <stdio.h>
        #include "6 dof.h"
        int main(void)
        {
            const pf_model *m = &_6_dof_model;
            fprintf(stderr, "%d %d", _6_DOF_AXIS_1__ARM_, _6_DOF_SENSOR_INT);
            fwrite(m->axis, sizeof *m->axis, (size_t)m->axes, stdout);
            fwrite(m->sensor, sizeof *m->sensor, (size_t)m->sensors, stdout);
            fwrite(m->view, sizeof *m->view, (size_t)(m->axes * m->sensors), stdout);
            return 0;
        }
    """)
    with mock.patch("pumafuse.live.estimator.Window", wraps=Window) as window:
        pf.LiveEstimator(pf.FusionConfig.load(tmp_path / "fusion.toml"))
    model = window.call_args.args[0]
    done = subprocess.run([compiled(tmp_path, source)], capture_output=True, check=True)
    expected = np.concatenate([part.ravel().view(np.float64) for part in model])
    assert len(expected) == 2 * 29 + 2 * 5 + 4 * 5
    np.testing.assert_array_equal(np.frombuffer(done.stdout), expected)
    assert np.count_nonzero(np.isnan(expected)) == 3
    assert done.stderr == b"1 1"

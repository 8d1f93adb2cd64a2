"""Whole simulated runs: what is written is what was made, chance is reproducible and divided, frames and trials fit."""

import hashlib
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.csv as pacsv
import pytest

import pumafuse as pf
from pumafuse.logs.axes import in_axes
from pumafuse.logs.source import Source
from pumafuse.simulation.simulate import write

SCENARIOS = Path(__file__).parents[2] / "scenarios"
BASE = """
name = "test"
arm = "puma560-internal"
[trajectory]
kind = "raster"
along = "tangential"
across = "radial"
width_mm = 30.0
height_mm = 10.0
pitch_mm = 10.0
speed_m_s = 0.06
[process]
input_noise_mm_rtHz = 0.03
drift_mm_rts = 0.3
[sensors.eye]
rate_hz = 30.0
sd_mm = 0.5
latency_ms = 45.0
"""
EAR = "[sensors.ear]\nrate_hz = 77.0\nsd_mm = 0.1\n"


def load(folder: Path, text: str) -> pf.Scenario:
    path = folder / "scenario.toml"
    path.write_text(text)
    return pf.Scenario.load(path)


def same_source(one: Source, other: Source) -> None:
    assert np.array_equal(one.stamp, other.stamp)
    assert list(one.values) == list(other.values)
    for axis in one.values:
        assert np.array_equal(one.values[axis], other.values[axis]), axis  # to the last bit


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_a_reference_with_noise_of_its_own_says_so(tmp_path: Path) -> None:
    """Its noise has the sd asked for (4 standard errors), and the sd is in the run."""
    loud, quiet = (load(tmp_path, BASE + f"[reference]\nsd_mm = {sd}\n") for sd in (0.2, 0.0))
    noisy, clean = pf.simulate(loud).run.reference, pf.simulate(quiet).run.reference
    assert noisy is not None and clean is not None and noisy.sd == 2e-4
    noise = np.concatenate([noisy.values[axis] - clean.values[axis] for axis in noisy.values]) / 2e-4
    assert abs(np.mean(noise**2) - 1.0) < 4.0 * (2.0 / len(noise)) ** 0.5


CHANGES = (
    ("77.0", "2142.0"),
    ("77.0", "77.0\nbursts = { per_minute = 60.0, length_s = 0.1 }"),
    ("77.0", "77.0\noutliers = { share = 0.2, from_mm = 5.0, to_mm = 9.0 }"),
    ("77.0", "77.0\nlatency_sd_ms = 3.0"),
)


@pytest.mark.parametrize(("was", "now"), CHANGES)
def test_a_sensor_changes_no_other_measurement_and_no_motion(was: str, now: str, tmp_path: Path) -> None:
    """To the last bit, on an arm that strays, has play, and whose commands are late by chance."""
    loose = BASE + "[true_arm]\nbacklash_mm = 0.2\nstiction_mm = 0.1\ndelay_jitter_ms = 2.0\n" + EAR
    one, two = (pf.simulate(load(tmp_path, text)).run for text in (loose, loose.replace(was, now)))
    same_source(one.command, two.command)
    assert one.reference is not None and two.reference is not None
    same_source(one.reference, two.reference)
    same_source(one.sensors["eye"], two.sensors["eye"])
    with pytest.raises(AssertionError):
        same_source(one.sensors["ear"], two.sensors["ear"])


def test_commands_are_given_at_their_ticks_and_logged_with_jitter(tmp_path: Path) -> None:
    """The motion keeps to the ticks; stamps scatter around them by the sd asked for (4 standard errors), in order."""
    plain, jittering = (
        pf.simulate(load(tmp_path, BASE + more)).run
        for more in ("", '[command]\nstamp_jitter_ms = 2.0\nclock = "regular"\n')
    )
    tick = np.rint(np.arange(len(plain.command.stamp)) * 28e6)
    assert (plain.command.stamp == tick).all()
    off = (jittering.command.stamp - tick) / 2e6
    assert abs(np.mean(off**2) - 1.0) < 4.0 * (2.0 / len(off)) ** 0.5
    assert (np.diff(jittering.command.stamp) >= 0).all()
    assert jittering.clock == "regular"
    assert plain.reference is not None and jittering.reference is not None
    same_source(plain.reference, jittering.reference)


ODD = """
name = 'odd "name" \\ [x]'
seed = 12345678901
arm = "arm.toml"
start_azimuth_deg = 33.3
[frame]
kind = "cylindrical"
base_mm = [0.1, -0.7]
positive = "clockwise"
[start]
offset_sd_mm = 0.123456789
level = { radial_mm = 512.3000001, tangential_mm = 0.1 }
[trajectory]
kind = "steps"
axes = ["tangential", "radial"]
sizes_mm = [2.1, 0.7]
trials = 3
rest_s = 0.4321
window_s = 0.333
scope = "ear"
[true_arm]
delay_ms = 61.7
gain_curve = { speed_m_s = [0.1, 0.3], gain = [0.99, 1.03] }
gain_recovery_ms = "never"
slow_drift_mm = 0.07
[true_arm.radial]
plant = "second-order"
natural_frequency_rad_s = 41.3
damping = 0.77
stiction_mm = 0.013
[process.tangential]
input_noise_mm_rtHz = 0.0137
maneuver_drift_mm_rts_per_m_s = 1.1
[command]
stamp_jitter_ms = 0.7
clock = "regular"
[reference]
rows_per_command = 7
sd_mm = 0.0011
[sensors.eye]
rate_hz = 29.97
rate_jitter_ms = 0.3
sd_mm = 0.1
latency_ms = 44.4
latency_sd_ms = 1.7
scale = -1.1
bias_mm = { x = 0.3, z = -0.1 }
bias_sd_mm = 0.9
quantisation_mm = 0.003
dropouts = 0.07
bursts = { per_minute = 7.7, length_s = 0.3 }
outliers = { share = 0.011, from_mm = 3.3, to_mm = 7.7 }
outages_s = [[0.1, 0.3], [0.7, 0.9]]
clock_offset_ms = -3.3
clock_drift_ppm = 17.7
[sensors.ear]
rate_hz = 333.3
axes = ["radial", "tangential"]
sd_mm = { tangential = 0.07, radial = 0.3 }
[filter.start]
offset_sd_mm = 0.7
[filter.process.radial]
drift_mm_rts = 0.77
[filter.sensors.eye]
latency_ms = 33.3
"""


@pytest.mark.parametrize("name", ["panel-vision", "odd"])
def test_a_written_folder_is_the_run_and_makes_it_again(name: str, tmp_path: Path) -> None:
    """Read back, it is the run in memory, bit for bit; its scenario.toml gives the same bytes again."""
    if name == "odd":
        (tmp_path / "arm.toml").write_text((SCENARIOS / "paper-arm.toml").read_text())
        scenario = load(tmp_path, ODD)
    else:
        scenario = pf.Scenario.load(SCENARIOS / f"{name}.toml")
    simulated = pf.simulate(scenario, 77)
    assert simulated.scenario == scenario and simulated.seed == 77
    write(simulated, tmp_path / "one", force=False)

    again, run = pf.Run.read(tmp_path / "one"), simulated.run
    same_source(run.command, again.command)
    assert list(run.sensors) == list(again.sensors)
    for sensor in run.sensors:
        same_source(run.sensors[sensor], again.sensors[sensor])
    same_source(run.reference, again.reference)
    assert again.reference.sd == run.reference.sd
    assert (again.name, again.start, again.clock, again.frame) == (run.name, run.start, run.clock, run.frame)
    assert again.notes == ()
    assert pf.FusionConfig.load(tmp_path / "one" / "fusion.toml") == simulated.config

    loaded = pf.Scenario.load(tmp_path / "one" / "scenario.toml")
    assert loaded.true_axes == scenario.true_axes and loaded.config == scenario.config
    whole = {"seed": 77, "true_arm": {}, "process": {}}  # tables that all axes share are written for each
    assert msgspec.structs.replace(loaded, **whole) == msgspec.structs.replace(scenario, **whole)
    write(pf.simulate(loaded), tmp_path / "two", force=False)
    write(pf.simulate(loaded, 78), tmp_path / "other", force=False)
    one, two, other = (digests(tmp_path / folder) for folder in ("one", "two", "other"))
    assert one == two
    assert {"scenario.toml", "run.toml", "fusion.toml", "arm.toml", "commands.csv", "truth.csv"} <= set(one)
    assert all(one[f"{sensor}.csv"] != other[f"{sensor}.csv"] for sensor in run.sensors)


@pytest.mark.parametrize(
    ("kind", "positive"),
    [('kind = "cylindrical"', "clockwise"), ('kind = "rotated"\nazimuth_deg = 37.0', "counterclockwise")],
)
def test_a_log_in_x_y_z_gives_the_axes_back(kind: str, positive: str, tmp_path: Path) -> None:
    """Turned into axes, commands and reference are those of the same scenario without a frame, to rounding (2 nm)."""
    level = "[start]\noffset_sd_mm = 0.0\nlevel = { radial_mm = 560.0, tangential_mm = 0.0, vertical_mm = -100.0 }\n"
    frame = f'[frame]\n{kind}\npositive = "{positive}"\n' + ("base_mm = [20.0, -30.0]\n" if "cyl" in kind else "")
    text = "start_azimuth_deg = 110.0\n" + BASE + level
    plain, logged = (pf.simulate(load(tmp_path, text + more)).run for more in ("", frame))
    assert list(logged.command.values) == ["x", "y", "z"]
    back, placed = in_axes(logged, None)
    assert placed is not None
    assert back.start["radial"] == pytest.approx(0.560, abs=2e-9)
    assert back.start["tangential"] == pytest.approx(0.0, abs=2e-9)
    assert plain.reference is not None and back.reference is not None
    for one, two in ((plain.command, back.command), (plain.reference, back.reference)):
        for axis in ("tangential", "radial"):
            assert two.values[axis] == pytest.approx(one.values[axis], abs=3e-9)
    assert back.command.values["vertical"] == pytest.approx(-0.1, abs=1e-12)


STEPS = """
name = "steps"
arm = "puma560-internal"
[trajectory]
kind = "steps"
axes = ["tangential", "radial"]
sizes_mm = [2.0, 8.0]
replicates = 2
trials = 7
rest_s = 0.7
window_s = 0.4
scope = "scope"
[process]
input_noise_mm_rtHz = 0.0
drift_mm_rts = 0.0
[sensors.scope]
rate_hz = 535.7142857142857
sd_mm = 0.00001
latency_ms = 5.0
"""


def test_trials_are_cut_from_the_run_at_their_commands(tmp_path: Path) -> None:
    """Time 0 is the command: samples from 50 ms before it, at rest, to the window's end, on the step's own axis."""
    scenario = load(tmp_path, STEPS)
    simulated = pf.simulate(scenario)
    write(simulated, tmp_path / "run", force=False)
    trials = pacsv.read_csv(tmp_path / "run" / "trials.csv").to_pydict()
    samples = {k: np.array(v) for k, v in pacsv.read_csv(tmp_path / "run" / "samples.csv").to_pydict().items()}
    command = simulated.run.command
    steps = {axis: np.diff(value, prepend=value[0]) for axis, value in command.values.items()}
    given = sorted((t, axis, s) for axis in steps for t, s in zip(command.stamp, steps[axis], strict=True) if s)
    assert trials["trial"] == list(range(1, 8))
    assert trials["axis"] == [axis for _, axis, _ in given]
    assert trials["step_mm"] == pytest.approx([step * 1e3 for _, _, step in given], abs=1e-6)
    assert trials["speed_m_s"] == pytest.approx([abs(step) / 0.028 for _, _, step in given], abs=1e-6)
    assert trials["direction"] == ["up" if step > 0.0 else "down" for _, _, step in given]
    scope = simulated.run.sensors["scope"]
    for number, (at, axis, step) in enumerate(given, 1):
        mine = samples["trial"] == number
        time, position = samples["time_s"][mine], samples["position_mm"][mine]
        assert -0.05 <= time[0] < -0.047 and 0.397 < time[-1] <= 0.4
        assert np.diff(time) == pytest.approx(0.028 / 15, abs=1e-8)
        logged = np.searchsorted(scope.stamp, np.rint((time + 0.005) * 1e9 + at) - 2)
        assert position == pytest.approx(scope.values[axis][logged] * 1e3, abs=1e-6)
        model = scenario.arm.axes[axis]
        delay = scenario.arm.delay_of(axis)
        rest = position[time < delay].mean()
        assert np.ptp(position[time < delay]) < 0.005 + 0.002 * abs(step) * 1e3
        assert position[-1] - rest == pytest.approx(step * 1e3, abs=0.03 * abs(step) * 1e3)
        # With its gain error on the way out, the rise lies between the plant's answer to the step and to K times it.
        gain = float(model.gain.at(np.array(abs(step) / 0.028)))
        answer = np.asarray(model.plant.step_response(time - delay)) * step * 1e3
        off = (position - rest - answer) / (step * 1e3)
        assert np.abs(off).max() < abs(gain - 1.0) + 0.02

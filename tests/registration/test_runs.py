"""``register`` of recorded runs, and what is fused with what it writes."""

import gzip
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

import pumafuse as pf
from executable import pumafuse, refused
from pumafuse.registration.motion import Motion
from pumafuse.registration.register import register_sensor as registration
from pumafuse.registration.runs import RegisteredSensor, Registrations
from setups import Setup

pytestmark = pytest.mark.xdist_group("registered runs")  # what is registered once serves many
RUNS = Path(__file__).parents[2] / "examples" / "pose-virtual"
TRUE = {  # of the simulation that the runs are from: how each sensor is turned [deg], what it sees [mm]
    "mocap": ((-148.119668, 52.631573, -6.871825), (30.0, -50.0, 120.0)),
    "tracker": ((-1.993468, 0.207007, -112.001045), (0.0, 62.0, 35.0)),
}


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("register") / "out"
    pumafuse("register", RUNS / "inspect1", "-o", folder, "--to", 45)
    return folder


def turned_by(config: Path) -> dict[str, float]:
    """By how much the frames of sensors are turned against the true ones [deg]."""
    found: dict[str, float] = {}
    for name, sensor in pf.FusionConfig.load(config).sensors.items():
        true = Rotation.from_rotvec(TRUE[name][0], degrees=True)
        found[name] = float(np.degrees((Rotation.from_rotvec(sensor.frame.rotation) * true.inv()).magnitude()))
    return found


@pytest.mark.long
def test_what_is_written_as_json_is_what_is_configured(registered: Path) -> None:
    """Numbers are in the units of their names, each with an interval that holds it."""
    told = json.loads((registered / "registration.json").read_text())
    config = pf.FusionConfig.load(registered / "fusion.toml")
    for name, one in told["sensors"].items():
        frame = config.sensors[name].frame
        np.testing.assert_allclose(one["frame"]["at_mm"], np.array(frame.at) * 1e3, atol=1e-3)
        for value, (low, high) in zip(one["frame"]["at_mm"], one["frame"]["at_mm_ci95"], strict=True):
            assert low < value < high
        low, high = one["lag_ms_ci95"]
        assert low < one["lag_ms"] < high
        assert one["latency_ms"] == pytest.approx(config.sensors[name].latency * 1e3, abs=1e-3)
        assert 0.1 < one["rms_mm"] < 2.0  # the arm's kinematics are 0.5 mm and 0.2° wrong
    assert 0.05 < told["sensors"]["mocap"]["rms_deg"] < 0.5


@pytest.fixture(scope="module")
def each() -> list[dict[str, RegisteredSensor]]:
    """The sensors as each of the two runs tells them."""
    return [pf.register(pf.Run.read(RUNS / name)).details.sensors for name in ("inspect1", "wander1")]


@pytest.mark.long
def test_intervals_hold_what_is_true(each: list[dict[str, RegisteredSensor]]) -> None:
    """Of the markers and of how frames are turned, of either run, 90 % or more: the arm's own errors are counted."""
    inside: list[bool] = []
    for sensors in each:
        for name, (turned, marker) in TRUE.items():
            frame, seen = sensors[name].frame, sensors[name].marker
            for true, between in zip(np.radians(turned), frame.rotation_ci95, strict=True):
                inside.append(between[0] < true < between[1])
            for true, between in zip(1e-3 * np.array(marker), seen.at_ci95, strict=True):
                inside.append(between[0] < true < between[1])
    assert np.mean(inside) >= 0.9


@pytest.mark.long
@pytest.mark.parametrize("sensor", ["mocap", "tracker"])
def test_another_run_of_the_set_up_is_fused_by_it(registered: Path, sensor: str) -> None:
    """About the arm's constant error the tool is known to 0.6 mm and 0.3°, untuned; error bars hold for the sum.

    The tracker's latency of 5 ms is not known: at 100 mm/s these are 0.5 mm.
    """
    run = pf.Run.read(RUNS / "wander1")
    est = pf.fuse(run, pf.FusionConfig.load(registered / "fusion.toml"), sensors=[sensor])
    settled = est.time > 3.0
    for axis, estimate in est.axes.items():
        known = np.interp(est.time, est.reference.time, est.reference.position[axis])
        scatter = float(np.std((estimate.position - known)[settled]))
        inside = np.abs(estimate.position - known)[settled] < 1.96 * estimate.position_sd[settled]
        assert inside.mean() > 0.9, axis  # what no motion shows of the arm's kinematics is in the error bars
        assert scatter < (np.radians(0.3) if axis.startswith("r") else 0.6e-3), axis


def test_a_marker_that_is_fixed_stays(tmp_path: Path, registered: Path) -> None:
    """With ``--fix marker`` the frame alone is found, beside the marker that somebody measured."""
    pumafuse(
        "register", RUNS / "inspect1", "-c", registered / "fusion.toml", "--sensor", "tracker", "--fix", "marker",
        "-o", tmp_path / "out", "--to", 30,
    )  # fmt: skip
    before, after = (pf.FusionConfig.load(one / "fusion.toml").sensors for one in (registered, tmp_path / "out"))
    assert before["tracker"].marker == after["tracker"].marker
    assert before["mocap"] == after["mocap"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--sensor", "camera"), "unknown sensor 'camera'"),
        (("--fix", "frame"), "--fix"),
        (("-c", "nowhere.toml"), "nowhere.toml: no such file"),
    ],
)
def test_what_cannot_be_registered_is_one_line(arguments: tuple[str, ...], words: str) -> None:
    assert words in refused("register", RUNS / "inspect1", *arguments)


def test_commands_without_a_position_register_nothing() -> None:
    """A sensor is registered beside commands in x, y and z."""
    time = np.arange(0.0, 8.0, 0.02)
    run = pf.Run.from_arrays(time, {"pan": np.sin(time)}, {"camera": (time, {"pan": np.sin(time)})})
    with pytest.raises(pf.RunError, match=r"beside commands in x, y and z; there are only pan"):
        pf.register(run)


def recorded(change: Callable[[np.ndarray], np.ndarray], *, told: bool = True, seconds: float = 30.0) -> pf.Run:
    """A simulated set-up whose sensor's positions are changed; ``told``: whether the commands have an orientation."""
    command, sensor = Setup(4, seconds=seconds).run()
    turns = {"orientation": command.quaternion} if told else {}
    told_axes = dict(zip("xyz", command.position.T, strict=True)) | turns
    seen = dict(zip("xyz", change(sensor.position).T, strict=True)) | {"orientation": sensor.quaternion}
    return pf.Run.from_arrays(command.time, told_axes, {"camera": (sensor.time, seen)})


def as_it_is(position: np.ndarray) -> np.ndarray:
    return position


def lost(position: np.ndarray) -> np.ndarray:
    """Zeros in every tenth row, as a sensor writes them that lost its target."""
    found = position.copy()
    found[::10] = 0.0
    return found


def held(position: np.ndarray) -> np.ndarray:
    """Each value three times, as of a sensor that is slower than its rows."""
    return position[np.arange(len(position)) // 3 * 3]


@pytest.mark.long
@pytest.mark.parametrize("change", [lost, held])
def test_rows_that_are_no_news_change_no_frame(change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Zeros of a lost sensor are missing, and a value that is repeated counts once: within 1 mm and 0.1°."""
    whole, found = (pf.register(recorded(one)).config.sensors["camera"].frame for one in (as_it_is, change))
    np.testing.assert_allclose(found.at, whole.at, atol=1e-3)
    np.testing.assert_allclose(found.rotation, whole.rotation, atol=np.radians(0.1))


@pytest.mark.long
def test_a_gap_of_the_commands_is_named_and_costs_nothing_else() -> None:
    """When it is and how long is said; orientations are used, and the frame stays within 1 mm and 0.1°."""
    whole = recorded(as_it_is, seconds=40.0)
    time = (whole.command.stamp - whole.command.stamp[0]) / 1e9
    run = replace(whole, command=whole.command.rows((time < 11.0) | (time > 26.0)))
    with pytest.warns(pf.PumafuseWarning, match=r"the longest gap is 15 s, from 1[01]\.\d\d s on: what sensors saw in"):
        found = pf.register(run)
    assert found.details.sensors["camera"].angular_rms is not None
    frame, expected = found.config.sensors["camera"].frame, pf.register(whole).config.sensors["camera"].frame
    np.testing.assert_allclose(frame.at, expected.at, atol=1e-3)
    np.testing.assert_allclose(frame.rotation, expected.rotation, atol=np.radians(0.1))


@pytest.mark.long
def test_noise_by_a_sensor_s_axes_is_turned_when_its_frame_is_found_and_then_stays() -> None:
    """What was along its own axes, as no frame was known, is along the base's; what is that already is not changed."""
    run, sds = recorded(as_it_is, seconds=20.0), np.array([1e-4, 2e-4, 8e-4])

    def registered_from(config: pf.FusionConfig, **changes: object) -> tuple[pf.FusionConfig, np.ndarray]:
        camera = msgspec.structs.replace(config.sensors["camera"], **changes)
        found = pf.register(run, msgspec.structs.replace(config, sensors={"camera": camera})).config
        return found, np.array([found.sensors["camera"].sd_of(axis) for axis in "xyz"])

    config = pf.register(run).config
    angles = {axis: config.sensors["camera"].sd_of(axis) for axis in ("rx", "ry", "rz")}
    found, turned = registered_from(config, frame=None, sd=dict(zip("xyz", sds.tolist(), strict=True)) | angles)
    along = Rotation.from_rotvec(found.sensors["camera"].frame.rotation).as_matrix()
    np.testing.assert_allclose(turned, np.sqrt(along**2 @ sds**2), rtol=1e-9)
    assert np.ptp(turned) > 1e-5
    np.testing.assert_array_equal(registered_from(found)[1], turned)


def along_base(marker: float) -> pf.Run:
    """A run beside a sensor that measures along the base's axes, so many times the marker of a set-up on the tool."""
    setup = Setup(3, seconds=12.0, wrong=1.0)
    setup.frame, setup.at = Rotation.identity(), np.zeros(3)
    setup.marker, setup.turn = marker * setup.marker, setup.turn if marker else Rotation.identity()
    command, sensor = setup.run()
    told, seen = (
        dict(zip("xyz", one.position.T, strict=True)) | {"orientation": one.quaternion} for one in (command, sensor)
    )
    return pf.Run.from_arrays(command.time, told, {"camera": (sensor.time, seen)})


def test_a_sensor_along_the_axes_of_the_base_gets_no_frame() -> None:
    """Nor a marker if that is the tool point; what is configured of its bias stays."""
    with pytest.warns(pf.PumafuseWarning, match="sensor 'camera' measures along the base's axes"):
        found = pf.register(along_base(0.0))
    camera = found.config.sensors["camera"]
    assert camera.frame is None
    assert camera.marker is None
    assert found.details.sensors["camera"].frame is not None
    sensors = {"camera": msgspec.structs.replace(camera, bias_sd=2e-3)}
    given = msgspec.structs.replace(found.config, sensors=sensors)
    with pytest.warns(pf.PumafuseWarning, match="no frame is written"):
        camera = pf.register(along_base(1.0), given).config.sensors["camera"]
    assert camera.frame is None
    assert camera.bias_sd == 2e-3
    np.testing.assert_allclose(camera.marker.at, Setup(3).marker, atol=2e-3)


@pytest.mark.long
def test_a_sensor_that_lacks_an_axis_is_named() -> None:
    """What it lacks, and what becomes of it; where it is the only one nothing is registered, in a line."""
    run = recorded(as_it_is)
    camera = run.sensors["camera"]
    flat = replace(camera, values={axis: camera.values[axis] for axis in "xy"}, orientation=None)
    with pytest.warns(pf.PumafuseWarning, match="sensor 'flat' gives no z, without which it is not registered"):
        found = pf.register(replace(run, sensors={"camera": camera, "flat": flat}))
    assert found.config.sensors["camera"].frame is not None
    with pytest.raises(pf.RunError, match=r"no sensor gives x, y and z, .*: sensor 'flat' gives no z"):
        pf.register(replace(run, sensors={"flat": flat}))


@pytest.mark.long
def test_a_run_in_which_a_sensor_lacks_an_axis_is_not_looked_at_for_it() -> None:
    """The sensor is registered by the other run alone."""
    run = recorded(as_it_is)
    camera = run.sensors["camera"]
    level = replace(camera, values={"z": camera.values["z"]}, orientation=None)
    both = pf.register([run, replace(run, sensors={"camera": level})]).config.sensors["camera"]
    assert both.frame == pf.register(run).config.sensors["camera"].frame


def test_poses_of_a_bag_are_registered(tmp_path: Path) -> None:
    """Commands in a Pose and a sensor in a Transform, both within other fields: the frame is that of the arrays."""
    motions, text = Setup(4, seconds=12.0).run(), ""
    kinds = {"pose": ("position", "orientation"), "transform": ("translation", "rotation")}
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "")
        for name, (kind, parts), motion in zip(("command", "sensors.camera"), kinds.items(), motions, strict=True):
            text += f'[{name}]\nfile = "log.mcap"\ntopic = "/{name}"\ntime = "log_time"\npose = "a.{kind}"\n'
            schema = writer.register_schema("a", "jsonschema", b"{}")
            channel = writer.register_channel(f"/{name}", "json", schema)
            for time, *pose in zip(*motion, strict=True):
                fields = zip(parts, ("xyz", "xyzw"), pose, strict=True)
                message = {part: dict(zip(letters, of.tolist(), strict=True)) for part, letters, of in fields}
                stamp = round(1e9 * (10.0 + time))
                writer.add_message(channel, stamp, json.dumps({"a": {kind: message}}).encode(), stamp)
        writer.finish()
    (tmp_path / "run.toml").write_text(text)
    alone = registration(*([motion._replace(time=motion.time + 10.0)] for motion in motions)).frame
    found = pf.register(pf.Run.read(tmp_path)).details.sensors["camera"].frame
    np.testing.assert_allclose(found.at, alone.at, atol=1e-6)
    np.testing.assert_allclose(found.rotation, alone.rotation, atol=1e-6)


@pytest.mark.long
def test_what_no_frame_explains_is_refused() -> None:
    """Commands without an orientation, of a tool that turns with a marker far from its point: said, not guessed."""
    with pytest.raises(pf.RunError, match=r"no frame explains how: .* the commands tell no orientation"):
        pf.register(recorded(as_it_is, told=False))


def test_a_motion_along_one_axis_is_registered_as_far_as_it_tells() -> None:
    """Commands that never change on two axes are no fault, and numbers that the motion does not tell say so."""
    time, rng = np.arange(0.0, 20.0, 0.02), np.random.default_rng(5)
    seen = np.arange(0.2, 20.0, 0.01)
    told = {"x": 0.1 * np.sin(time), "y": np.full(len(time), 0.05), "z": np.full(len(time), 0.08)}
    values = [0.1 * np.sin(seen - 0.1), np.full(len(seen), 0.05), np.full(len(seen), 0.08)]
    noisy = {axis: value + rng.normal(0.0, 1e-4, len(seen)) for axis, value in zip("xyz", values, strict=True)}
    run = pf.Run.from_arrays(time, told, {"camera": (seen, noisy)})
    with pytest.warns(pf.PumafuseWarning, match="motion along|does not turn|do not tell|no frame is written"):
        found = pf.register(run).details.sensors["camera"]
    assert {"line", "along-base"} <= {*found.findings}
    assert found.lag == pytest.approx(0.09, abs=1e-3)  # 0.1 s behind the path, half a period less behind held commands


def of_columns(motion: Motion) -> dict[str, np.ndarray]:
    """What a motion has for :meth:`pumafuse.Run.from_arrays`."""
    turns = {} if motion.quaternion is None else {"orientation": motion.quaternion}
    return dict(zip("xyz", motion.position.T, strict=True)) | turns


SETUP = partial(Setup, 5, seconds=30.0, wrong=1.0, outliers=0.0)


def two_sensors(turned: Rotation | None = None) -> pf.Run:
    """One that sees the tool point alone, and a noisier one 30 ms later that sees a marker and how it is turned."""
    early, late = SETUP(orientation=False), SETUP(sd=0.5e-3)
    early.marker = np.zeros(3)
    (command, pose), point = late.run(), early.run()[1]
    if turned is not None:
        pose = pose._replace(quaternion=(turned * Rotation.from_quat(pose.quaternion)).as_quat())
    sensors = {"early": (point.time, of_columns(point)), "late": (pose.time + 0.03, of_columns(pose))}
    return pf.Run.from_arrays(command.time, of_columns(command), sensors)


@pytest.fixture(scope="module")
def both() -> Registrations:
    return pf.register(two_sensors())


@pytest.mark.long
def test_the_arm_answers_as_the_earliest_sensor_saw_it(both: Registrations) -> None:
    """In position; in orientation as the later one saw it, less what that is later. Its latency is 30 ms, to 0.1 ms."""
    (of_points, of_turns), arm = SETUP().lags, both.config.arm
    assert [arm.lag_of(axis) for axis in "xyz"] == pytest.approx([of_points] * 3, abs=3e-4)
    assert [arm.lag_of(axis) for axis in ("rx", "ry", "rz")] == pytest.approx([of_turns] * 3, abs=3e-4)
    assert both.config.sensors["early"].latency == 0.0
    assert both.config.sensors["late"].latency == pytest.approx(0.03, abs=1e-4)


@pytest.mark.long
def test_white_noise_is_no_error_of_the_arm(both: Registrations) -> None:
    """It errs by 0.5 mm and 0.2 degrees, of which each of two sensors has √2 times as much: the noise is left out.

    An offset to begin with is three times as unsure as the arm is off.
    """
    told, config = both.details.sensors["late"], both.config
    for sensor in config.sensors.values():
        for axis in "xyz":
            assert 0.6 < sensor.bias_sd_of(axis) / (np.sqrt(2.0) * 0.5e-3) < 1.4
        for axis in ("rx", "ry", "rz"):
            assert sensor.bias_sd_of(axis) == pytest.approx(np.sqrt(2.0) * told.angular_rms, rel=0.05)
            assert config.start.offset_sd_of(axis) == pytest.approx(3.0 * told.angular_rms, rel=1e-3)


@pytest.mark.long
def test_the_delay_that_latencies_leave_is_that_of_the_surer_sensor(both: Registrations) -> None:
    """Where fixed latencies contradict each other each counts as its lag is sure; on axes with own delays, too."""
    latencies = {"early": 0.01, "late": 0.06}  # s; as they are one is 30 ms later
    sensors = {name: msgspec.structs.replace(one, latency=latencies[name]) for name, one in both.config.sensors.items()}
    given = msgspec.structs.replace(both.config, sensors=sensors)
    found = pf.register(two_sensors(), given, fix=["latency"])
    assert {name: one.latency for name, one in found.config.sensors.items()} == latencies
    of_arm, weight = list[float](), list[float]()
    for name, one in found.details.sensors.items():
        of_arm.append(one.lag - latencies[name])
        weight.append((one.lag_ci95[1] - one.lag_ci95[0]) ** -2)
    wanted = np.average(of_arm, weights=weight)
    assert abs(wanted - np.mean(of_arm)) > 3e-3
    assert found.config.arm.lag_of("x") == pytest.approx(wanted, abs=2e-6)
    moved = [after.delay_of("rx") - before.delay_of("rx") for after, before in [(found.config.arm, given.arm)]]
    assert moved == pytest.approx([found.config.arm.delay_of("x") - given.arm.delay_of("x")], abs=2e-6)


@pytest.mark.long
def test_an_arm_that_is_configured_leaves_the_latencies(both: Registrations) -> None:
    """One that is 20 ms earlier than the earliest sensor saw it: its latency is these, and the other's 30 ms more."""
    earlier = msgspec.structs.replace(both.config.arm, delay=both.config.arm.delay - 0.02)
    found = pf.register(two_sensors(), msgspec.structs.replace(both.config, arm=earlier))
    late = [found.config.sensors[name].latency for name in ("early", "late")]
    assert late == pytest.approx([0.02, 0.05], abs=3e-4)
    assert found.config.arm == earlier


def test_orientations_that_do_not_follow_are_not_fused() -> None:
    """Those in a frame of their own are named, and the configuration that is written has no noise of them."""
    with pytest.warns(
        pf.PumafuseWarning, match="another frame than positions, turned by 5[78].*: its orientations are not"
    ):
        found = pf.register(two_sensors(Rotation.from_rotvec([0.0, 1.0, 0.0])), sensor="late")
    assert list(found.config.sensors) == ["late"]
    assert "x" in found.config.sensors["late"].sd and "rx" not in found.config.sensors["late"].sd


# ---- logs of which nothing is known ---------------------------------------------------------------------------------


def log(folder: Path, *names: str, until: float = 31.0) -> Path:
    """The first half minute of some files, without a word on what they are."""
    folder.mkdir()
    for name in names:
        head, *lines = gzip.decompress((RUNS / "inspect1" / f"{name}.csv.gz").read_bytes()).decode().splitlines()
        kept = [line for line in lines if float(line.partition(",")[0]) < until]
        (folder / f"{name}.csv").write_text("\n".join([head, *kept]) + "\n")
    return folder


@pytest.mark.long
def test_init_registers_sensors_in_frames_of_their_own(tmp_path: Path) -> None:
    """Where speeds follow and axes do not, frames are found and written, and ``latency`` says what to do instead."""
    done = pumafuse("init", log(tmp_path / "log", "commands", "mocap", "tracker"), "-o", tmp_path / "found")
    assert "looks to stand in a frame of its own" in done.stdout
    assert max(turned_by(tmp_path / "found" / "fusion.toml").values()) < 0.35
    assert "`pumafuse register` finds it" in refused("latency", tmp_path / "found")


@pytest.mark.long
def test_fuse_of_such_a_log_is_of_the_tool(tmp_path: Path) -> None:
    """The one command registers, tunes and fuses: the tool is known to half a millimetre about a constant."""
    done = pumafuse("fuse", log(tmp_path / "log", "commands", "tracker"), "-o", tmp_path / "fused")
    assert done.stdout.count("the latency of tracker is taken to be 0 ms") == 1
    assert turned_by(tmp_path / "fused" / "fusion.toml")["tracker"] < 0.5
    est = pf.fuse(pf.Run.read(tmp_path / "fused"), pf.FusionConfig.load(tmp_path / "fused" / "fusion.toml"))
    true = pf.Run.read(RUNS / "inspect1").reference
    time = (true.stamp - est.origin) / 1e9
    for axis in "xyz":
        off = est[axis].position - np.interp(est.time, time, true.values[axis])
        assert np.std(off[est.time > 3.0]) < 0.7e-3, axis

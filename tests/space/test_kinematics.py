"""Forward kinematics of a URDF's chain, against Denavit-Hartenberg, products of 4x4 matrices, and recorded commands."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from pumafuse.errors import ConfigError, UnknownNameError
from pumafuse.space import rotations
from pumafuse.space.kinematics import Chain
from refusals import one_line

PUMA = Path(__file__).parents[2] / "examples" / "pose-virtual" / "puma560.urdf"
COMMANDS = Path(__file__).with_name("commands.csv")
# d [m], a [m], alpha [rad] of each link: what the controller of the recorded PUMA 560 computes with
DENAVIT_HARTENBERG = [
    (0.0, 0.0, math.pi / 2),
    (0.0, 0.4318, 0.0),
    (0.15005, 0.0203, -math.pi / 2),
    (0.4318, 0.0, math.pi / 2),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.0, 0.0),
]
TOOL = 0.05625  # m along the last z
EXACT = 1e-12  # m, rad: some roundings of numbers of some metres

ONE = '<robot name="r"><link name="l0"/><link name="l1"/><link name="l2"/>{}</robot>'
ENDS = '<parent link="l0"/><child link="l1"/>'
BOMB = '<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>' + ONE.format("&b;")

numbers = st.floats(-2.0, 2.0)
vectors = st.tuples(numbers, numbers, numbers)


@dataclass(frozen=True)
class Given:
    """A joint of a random chain."""

    type: str
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]
    axis: tuple[float, ...]
    mimic: tuple[int, float, float] | None = None  # the joint's number, multiplier, offset


joints = st.builds(
    Given,
    st.sampled_from(["revolute", "continuous", "prismatic", "fixed"]),
    vectors,
    vectors,
    vectors.filter(lambda axis: math.hypot(*axis) > 0.1),
    st.none() | st.tuples(st.integers(0, 6), numbers, numbers),
)


def moving(chain: list[Given]) -> list[int]:
    """Joints that are driven by themselves: a mimic counts only of one that is."""
    return [number for number, joint in enumerate(chain) if joint.type != "fixed" and follows(chain, joint) is None]


def follows(chain: list[Given], joint: Given) -> tuple[int, float, float] | None:
    """What a joint mimics, if that is a joint that moves by itself."""
    if joint.mimic is None or joint.mimic[0] >= len(chain):
        return None
    target = chain[joint.mimic[0]]
    return joint.mimic if target.type != "fixed" and target.mimic is None else None


def words(values: tuple[float, ...]) -> str:
    return " ".join(map(repr, values))


def written(chain: list[Given]) -> str:
    """The URDF of a chain l0, l1, ... of joints j0, j1, ..., beside which another branch hangs."""
    lines = ['<robot name="random">', '<link name="l0"/>']
    for number, joint in enumerate(chain):
        mimic = follows(chain, joint)
        lines += [
            f'<joint name="j{number}" type="{joint.type}"><parent link="l{number}"/><child link="l{number + 1}"/>',
            f'<origin xyz="{words(joint.xyz)}" rpy="{words(joint.rpy)}"/><axis xyz="{words(joint.axis)}"/>',
            f'<mimic joint="j{mimic[0]}" multiplier="{mimic[1]!r}" offset="{mimic[2]!r}"/>' if mimic else "",
            f'</joint><link name="l{number + 1}"/>',
        ]
    lines += ['<joint name="aside" type="floating"><parent link="l0"/><child link="hand"/></joint>']
    return "\n".join([*lines, '<link name="hand"/></robot>'])


def transform(rotation: Rotation, position: tuple[float, ...] | np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    return matrix


def by_matrices(chain: list[Given], q: dict[int, float]) -> list[np.ndarray]:
    """The links' poses, one configuration at a time: the URDF's definition, written with scipy's rotations."""
    poses = [np.eye(4)]
    for number, joint in enumerate(chain):
        mimic = follows(chain, joint)
        value = mimic[1] * q[mimic[0]] + mimic[2] if mimic else q.get(number, 0.0)
        axis = np.array(joint.axis) / math.hypot(*joint.axis)
        motion = np.eye(4)
        if joint.type in ("revolute", "continuous"):
            motion = transform(Rotation.from_rotvec(value * axis))
        elif joint.type == "prismatic":
            motion = transform(Rotation.identity(), value * axis)
        poses.append(poses[-1] @ transform(Rotation.from_euler("xyz", joint.rpy), joint.xyz) @ motion)
    return poses


def loaded(folder: Path, text: str, base: str = "l0", tip: str = "l1") -> Chain:
    path = folder / "robot.urdf"
    path.write_text(text, encoding="utf-8")
    return Chain.load(path, base, tip)


def configurations(chain: Chain, count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-3.0, 3.0, (count, len(chain.joints)))


def turned(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The angle [rad] between orientations, which quaternions of either sign may be."""
    return (Rotation.from_quat(left).inv() * Rotation.from_quat(right)).magnitude()


def test_the_puma_is_that_of_denavit_and_hartenberg() -> None:
    """Position and orientation are the product Rz(q) Tz(d) Tx(a) Rx(alpha) over its links, at random configurations."""
    chain = Chain.load(PUMA, "base_link", "tool0")
    assert chain.joints == ("j1", "j2", "j3", "j4", "j5", "j6")
    assert set(chain.kinds.values()) == {"angle"}
    q = configurations(chain, 200)
    position, quaternion = chain.pose(q)
    assert position.shape == (200, 3)
    for row in range(200):
        pose = np.eye(4)
        for angle, (d, a, alpha) in zip(q[row], DENAVIT_HARTENBERG, strict=True):
            pose = pose @ transform(Rotation.from_euler("z", angle), (0.0, 0.0, d))
            pose = pose @ transform(Rotation.from_euler("x", alpha), (a, 0.0, 0.0))
        pose = pose @ transform(Rotation.identity(), (0.0, 0.0, TOOL))
        np.testing.assert_allclose(position[row], pose[:3, 3], atol=EXACT)
        np.testing.assert_allclose(Rotation.from_quat(quaternion[row]).as_matrix(), pose[:3, :3], atol=EXACT)


@pytest.mark.parametrize("run", ["inspect1", "wander1"])
def test_recorded_joints_are_recorded_poses(run: str) -> None:
    """What a controller told the joints is, through the kinematics, the pose that it told the tool.

    The file rounds joints to 1e-5°, positions to 1e-4 mm, quaternions to 1e-7. The six joints' roundings, at most 1 m
    from the tool, are together at most 5.2e-7 m and rad; those of a quaternion's parts at most 2e-7 rad.
    """
    with COMMANDS.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["run"] == run]
    chain = Chain.load(PUMA, "base_link", "tool0")
    q = np.radians([[float(row[f"{joint}_deg"]) for joint in chain.joints] for row in rows])
    position, quaternion = chain.pose(q)
    told = np.array([[float(row[f"{axis}_mm"]) / 1e3 for axis in "xyz"] for row in rows])
    assert np.ptp(told, axis=0).max() > 0.05, "the tool must move"
    np.testing.assert_allclose(position, told, atol=5.2e-7 + 0.5e-7)
    assert turned(quaternion, np.array([[float(row[f"q{part}"]) for part in "xyzw"] for row in rows])).max() < 7.2e-7


@settings(max_examples=100)
@given(st.lists(joints, min_size=1, max_size=7), st.integers(0, 2**32 - 1))
def test_random_chains(tmp_path_factory: pytest.TempPathFactory, chain: list[Given], seed: int) -> None:
    """Poses of tip and links, the order of the joints and their kinds: against the definition, by 4x4 matrices.

    The Jacobian is the slope of the pose: central differences err by the order 1e-10 of the third derivative.
    """
    arm = loaded(tmp_path_factory.mktemp("random"), written(chain), tip=f"l{len(chain)}")
    assert set(arm.joints) == {f"j{number}" for number in moving(chain)}
    for name, kind in arm.kinds.items():
        assert kind == ("length" if chain[int(name[1:])].type == "prismatic" else "angle")
    if all(follows(chain, joint) is None for joint in chain):
        assert list(arm.joints) == sorted(arm.joints)
    q = configurations(arm, 3, seed)
    position, quaternion = arm.pose(q)
    frames = arm.frames(q)
    assert arm.links == tuple(f"l{number}" for number in range(len(chain) + 1))
    for row in range(3):
        poses = by_matrices(chain, {int(name[1:]): value for name, value in zip(arm.joints, q[row], strict=True)})
        np.testing.assert_allclose(frames[row], poses, atol=20.0 * EXACT)  # of some 40 m
        np.testing.assert_allclose(position[row], poses[-1][:3, 3], atol=20.0 * EXACT)
        np.testing.assert_allclose(Rotation.from_quat(quaternion[row]).as_matrix(), poses[-1][:3, :3], atol=EXACT)
    jacobian = arm.jacobian(q)
    assert jacobian.shape == (3, 6, len(arm.joints))
    for joint in range(len(arm.joints)):
        step = np.zeros_like(q)
        step[:, joint] = 1e-5
        (after, turned_after), (before, turned_before) = arm.pose(q + step), arm.pose(q - step)
        turn = Rotation.from_quat(turned_after) * Rotation.from_quat(turned_before).inv()
        np.testing.assert_allclose(jacobian[:, :3, joint], (after - before) / 2e-5, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(jacobian[:, 3:, joint], turn.as_rotvec() / 2e-5, rtol=1e-7, atol=1e-7)


SMALL = {  # name: links and joints, the tip, the joints that must be known, their values, its position and its turn
    "defaults: no origin, about x, a mimic does the same": (
        f'<joint name="j" type="revolute">{ENDS}</joint><joint name="k" type="revolute"><parent link="l1"/>'
        '<child link="l2"/><mimic joint="j"/></joint>',
        "l2",
        {"j": "angle"},
        [0.3],
        [0.0, 0.0, 0.0],
        [2.0 * 0.3, 0.0, 0.0],
    ),
    "a fixed joint needs no axis; some programs write 0 0 0": (
        f'<joint name="j" type="fixed">{ENDS}<origin xyz="1 2 3"/><axis xyz="0 0 0"/></joint>',
        "l1",
        {},
        [],
        [1.0, 2.0, 3.0],
        [0.0, 0.0, 0.0],
    ),
    "a mimic of a mimic on another branch: factors multiply": (
        f"""<joint name="finger" type="prismatic">{ENDS}<axis xyz="0 3 0"/>
          <mimic joint="second" multiplier="0.5" offset="0.1"/></joint>
        <joint name="second" type="prismatic"><parent link="l0"/><child link="a"/>
          <mimic joint="screw" multiplier="-0.2" offset="0.4"/></joint>
        <joint name="screw" type="continuous"><parent link="a"/><child link="l2"/></joint>""",
        "l1",
        {"screw": "angle"},
        [3.0],
        [0.0, 0.5 * (-0.2 * 3.0 + 0.4) + 0.1, 0.0],
        [0.0, 0.0, 0.0],
    ),
}


@pytest.mark.parametrize(("text", "tip", "kinds", "q", "position", "turn"), SMALL.values(), ids=SMALL)
def test_small_chains(
    tmp_path: Path, text: str, tip: str, kinds: dict[str, str], q: list[float], position: list[float], turn: list[float]
) -> None:
    """By hand; a UTF-8 mark before the file does not matter."""
    chain = loaded(tmp_path, "\ufeff" + ONE.format(text), tip=tip)
    assert chain.kinds == kinds
    found, quaternion = chain.pose(np.array([q]))
    np.testing.assert_allclose(found, [position], atol=EXACT)
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_rotvec(), [turn], atol=EXACT)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_a_row_without_a_joint_is_nan_as_a_whole(tmp_path: Path, bad: float) -> None:
    """Also where that joint moves nothing of an output; the rows beside it are as without it."""
    slide = Given("prismatic", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    turn = Given("revolute", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    for number, chain in enumerate([[slide], [turn], [slide, turn]]):
        arm = loaded(tmp_path, written(chain), tip=f"l{len(chain)}")
        q = configurations(arm, 3)
        spoiled = q.copy()
        spoiled[1, -1] = bad
        for before, after in zip(
            (*arm.pose(q), arm.jacobian(q)), (*arm.pose(spoiled), arm.jacobian(spoiled)), strict=True
        ):
            assert np.isnan(after[1]).all(), number
            np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
        assert np.isnan(arm.frames(spoiled)[1, :, :3]).all()


def test_the_quaternion_does_not_jump() -> None:
    """Along a motion of whole turns its sign is continuous."""
    chain = Chain.load(PUMA, "base_link", "tool0")
    way = np.linspace(0.0, 1.0, 2000)[:, None] * np.array([9.0, -7.0, 8.0, 20.0, -9.0, 30.0])
    _, quaternion = chain.pose(way)
    assert np.abs(np.diff(quaternion, axis=0)).max() < 0.05


@pytest.mark.parametrize(
    ("base", "tip", "said"),
    [
        ("base_link", "tool", "unknown link 'tool'; did you mean 'tool0'? accepted: base_link, link1"),
        ("world", "tool0", "unknown link 'world'"),
        ("tool0", "link2", "no joints lead from link 'tool0' to 'link2'; above it: link1, base_link"),
    ],
)
def test_links_between_which_there_is_no_chain(base: str, tip: str, said: str) -> None:
    """The error has the links that there are, the nearest first, or those above the tip: none leads upwards."""
    assert said in one_line(UnknownNameError if "unknown" in said else ConfigError, lambda: Chain.load(PUMA, base, tip))


@pytest.mark.parametrize("shape", [(4, 5), (6,)])
def test_joints_of_another_number_are_refused(shape: tuple[int, ...]) -> None:
    """A column too many or too few is no configuration."""
    chain = Chain.load(PUMA, "base_link", "tool0")
    assert "expected (n, 6): j1, j2, j3, j4, j5, j6" in one_line(ConfigError, lambda: chain.pose(np.zeros(shape)))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("joint1,joint2\n1,2\n", "not a URDF: syntax error: line 1"),
        ("<sdf version='1.9'/>", "not a URDF: it begins with <sdf>, a URDF with <robot>"),
        (BOMB, "it has a DOCTYPE, which a URDF does not need"),
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>',
            "run `xacro robot.urdf > expanded.urdf` first",
        ),
        (
            f'<joint name="j" type="floating">{ENDS}</joint>',
            "joint 'j' is of type 'floating'; in a chain it must be revo",
        ),
        ('<joint name="j" type="fixed"><child link="l1"/></joint>', "joint 'j' has no <parent link=\"…\">"),
        (f'<joint name="j" type="revolute">{ENDS}<axis xyz="0 0 0"/></joint>', "axis 0 0 0 is no direction"),
        (f'<joint name="j" type="fixed">{ENDS}<origin rpy="0 0 nan"/></joint>', 'rpy="0 0 nan": expected 3 numbers'),
        (f'<joint name="j" type="fixed">{ENDS}<origin xyz="0 0 1e300"/></joint>', "each at most 1e+09"),
        (
            f'<joint name="j" type="fixed">{ENDS}<origin quat_xyzw="0 0 0 1"/></joint>',
            "origin has quat_xyzw; known are xyz and rpy",
        ),
        (
            f'<joint name="j" type="revolute">{ENDS}<mimic joint="j" multiplier="1 2"/></joint>',
            'mimic multiplier="1 2": expected a number',
        ),
        (f'<joint name="j" type="revolute">{ENDS}<mimic joint="j"/></joint>', "joints mimic in a circle: j, j"),
        (f'<joint name="j" type="revolute">{ENDS}<mimic joint="k"/></joint>', "mimic: unknown joint 'k'"),
        (
            f'<joint name="j" type="revolute">{ENDS}<mimic joint="k"/></joint>'
            '<joint name="k" type="fixed"><parent link="l0"/><child link="l2"/></joint>',
            "joint 'j' mimics 'k', which is fixed",
        ),
        (f'<joint name="j" type="fixed">{ENDS}</joint>' * 2, "two joints have the name 'j'"),
        (
            f'<joint name="j" type="fixed">{ENDS}</joint><joint name="k" type="fixed">{ENDS}</joint>',
            "joint 'k': joint 'j' has the same child 'l1'",
        ),
        (
            '<joint name="j" type="fixed"><parent link="l2"/><child link="l1"/></joint>'
            '<joint name="k" type="fixed"><parent link="l1"/><child link="l2"/></joint>',
            "the links go in a circle: l1, l2, l1",
        ),
    ],
)
def test_what_is_refused(tmp_path: Path, text: str, said: str) -> None:
    """Each mistake is one line that says where it is."""
    text = ONE.format(text) if text.startswith("<joint") else text
    line = one_line(ConfigError if "unknown" not in said else UnknownNameError, lambda: loaded(tmp_path, text))
    assert line.startswith(str(tmp_path / "robot.urdf"))
    assert said in line


def test_files_that_are_no_text(tmp_path: Path) -> None:
    """Absent, a folder, other encodings, in which an entity would hide."""
    assert "no such file" in one_line(ConfigError, lambda: Chain.load(tmp_path / "a.urdf", "l0", "l1"))
    assert "cannot be read" in one_line(ConfigError, lambda: Chain.load(tmp_path, "l0", "l1"))
    path = tmp_path / "b.urdf"
    path.write_bytes(BOMB.encode("utf-16"))
    assert "not a text file in UTF-8" in one_line(ConfigError, lambda: Chain.load(path, "l0", "l1"))
    path.write_bytes(b"<robot>" + b" " * (17 << 20) + b"</robot>")
    assert "more than 16 MB" in one_line(ConfigError, lambda: Chain.load(path, "l0", "l1"))


turns = arrays(np.float64, (5, 3), elements=st.floats(-1.8, 1.8))
letters = st.sampled_from(["ZYX", "xyz", "XYZ", "ZXZ", "zyz", "yxz"])


def same(quaternion: np.ndarray, rotation: Rotation) -> None:
    """Whether quaternions are those of a rotation of scipy, whatever their signs."""
    apart = (Rotation.from_quat(quaternion) * rotation.inv()).magnitude()
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)


@given(turns, turns)
def test_products_and_turned_vectors_are_those_of_scipy(first: np.ndarray, second: np.ndarray) -> None:
    """Quaternions of rotation turns, their products, inverses and what they turn are those of scipy."""
    a, b = Rotation.from_rotvec(first), Rotation.from_rotvec(second)
    p, q = rotations.of_vectors(first), rotations.of_vectors(second)
    same(rotations.product(p, q), a * b)
    same(rotations.inverse(p), a.inv())
    np.testing.assert_allclose(rotations.rotate(p, second), a.apply(second), atol=1e-12)
    np.testing.assert_allclose(rotations.matrix(first[0]), a[0].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations.angle_between(p, q), (a * b.inv()).magnitude(), atol=1e-7)


@given(turns, arrays(np.float64, 3, elements=st.floats(-1.8, 1.8)))
def test_axes_of_an_orientation_are_its_rotation_vector_from_the_reference(
    vector: np.ndarray, reference: np.ndarray
) -> None:
    """θ = Log(R R₀ᵀ) is scipy's rotation vector, and Exp(θ) R₀ is R again."""
    rotation, level = Rotation.from_rotvec(vector), Rotation.from_rotvec(reference)
    found = rotations.vectors(rotation.as_quat(), reference)
    same(rotations.of_vectors(found), rotation * level.inv())
    assert (np.linalg.norm(found, axis=1) <= np.pi + 1e-12).all()
    same(rotations.quaternions(found, reference), rotation)


@given(arrays(np.float64, (5, 3), elements=st.floats(-4.0, 4.0)), letters)
def test_euler_angles_of_every_convention_are_those_of_scipy(angle: np.ndarray, order: str) -> None:
    """Capital letters turn about axes that turn along, small ones about axes that stay."""
    same(rotations.of_angles(angle, order), Rotation.from_euler(order, angle))


def test_the_mean_orientation_is_that_of_scipy_whatever_the_signs() -> None:
    """Q and -q are one orientation, and rows that are NaN do not count."""
    rng = np.random.default_rng(5)
    rotation = Rotation.from_rotvec([0.4, -2.0, 1.0]) * Rotation.from_rotvec(rng.normal(0.0, 0.3, (50, 3)))
    quaternion = rotation.as_quat() * rng.choice([-1.0, 1.0], (50, 1))
    quaternion = np.vstack([quaternion, np.full((1, 4), np.nan)])
    same(rotations.of_vectors(rotations.mean(quaternion)[None]), rotation.mean())


def test_what_is_no_quaternion_is_missing() -> None:
    """A sensor that lost its target writes zeros; of a rounded quaternion the norm is near 1."""
    logged = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.0, 0.801], [np.nan, 0.0, 0.0, 1.0], [3.0, 4.0, 0.0, 0.0]])
    found = rotations.of_quaternions(logged)
    assert np.isnan(found).all(axis=1).tolist() == [True, False, True, True]
    assert np.linalg.norm(found[1]) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_array_equal(rotations.of_quaternions(logged[:, [3, 0, 1, 2]], "wxyz"), found)


@given(turns)
def test_the_left_jacobian_is_how_small_changes_turn(vector: np.ndarray) -> None:
    """Exp(θ + δ) Exp(θ)ᵀ is Exp(J δ), by differences, and J is sin(θ/2)/(θ/2) long across θ."""
    step = 1e-6
    found = rotations.left_jacobian(vector)
    for axis in range(3):
        ahead, behind = vector.copy(), vector.copy()
        ahead[:, axis] += step
        behind[:, axis] -= step
        turn = Rotation.from_rotvec(ahead) * Rotation.from_rotvec(behind).inv()
        np.testing.assert_allclose(found[:, :, axis], turn.as_rotvec() / (2.0 * step), atol=1e-8)
    angle = np.linalg.norm(vector, axis=1)
    shortest = np.linalg.svd(found, compute_uv=False)[:, -1]
    np.testing.assert_allclose(shortest, np.sinc(angle / 2.0 / np.pi), atol=1e-12)


def test_noise_of_the_axes_is_larger_far_from_the_reference() -> None:
    """At 110° noise moves θ by (θ/2)/sin(θ/2) across it and by itself along it: on average by the mean square."""
    angle = np.radians(110.0)
    across = (angle / 2.0) / np.sin(angle / 2.0)
    found = rotations.spread(np.array([[angle, 0.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
    np.testing.assert_allclose(found, [np.sqrt((1.0 + 2.0 * across**2) / 3.0), 1.0, 1.0], rtol=1e-12)

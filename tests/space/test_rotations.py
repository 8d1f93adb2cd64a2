"""Orientations, against scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from pumafuse.space import rotations

vectors = arrays(np.float64, (5, 3), elements=st.floats(-1.8, 1.8))
letters = st.sampled_from(["ZYX", "xyz", "XYZ", "ZXZ", "zyz", "yxz"])


def same(quaternion: np.ndarray, rotation: Rotation) -> None:
    """Whether quaternions are those of a rotation of scipy, whatever their signs."""
    apart = (Rotation.from_quat(quaternion) * rotation.inv()).magnitude()
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)


@given(vectors, vectors)
def test_products_and_turned_vectors_are_those_of_scipy(first: np.ndarray, second: np.ndarray) -> None:
    """Quaternions of rotation vectors, their products, inverses and what they turn are those of scipy."""
    a, b = Rotation.from_rotvec(first), Rotation.from_rotvec(second)
    p, q = rotations.of_vectors(first), rotations.of_vectors(second)
    same(rotations.product(p, q), a * b)
    same(rotations.inverse(p), a.inv())
    np.testing.assert_allclose(rotations.rotate(p, second), a.apply(second), atol=1e-12)
    np.testing.assert_allclose(rotations.matrix(first[0]), a[0].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations.angle_between(p, q), (a * b.inv()).magnitude(), atol=1e-7)


@given(vectors, arrays(np.float64, 3, elements=st.floats(-1.8, 1.8)))
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


@given(vectors)
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

"""Axes and orientations at the ROS edge, by tables of attitudes anybody can picture."""

import numpy as np
import pytest

from nav_ros import frames

EXACT = 1e-15
"""A few units in the last place of numbers of size one."""

A = np.sqrt(0.5)
C, S = np.cos(np.radians(15)), np.sin(np.radians(15))

ATTITUDES = [
    # what is seen, q_nb_wxyz (FRD to NED), orientation x y z w (FLU to ENU)
    ("level, facing east", (A, 0, 0, A), (0, 0, 0, 1)),
    ("level, facing north", (1, 0, 0, 0), (0, 0, A, A)),
    ("level, facing west", (A, 0, 0, -A), (0, 0, 1, 0)),
    ("level, facing south", (0, 0, 0, 1), (0, 0, -A, A)),
    ("nose 30 deg up, facing east", (A * C, -A * S, A * S, A * C), (0, -S, 0, C)),
    ("nose 30 deg up, facing north", (C, 0, S, 0), (A * S, -A * S, A * C, A * C)),
    ("right wing 30 deg down, facing east", (A * C, A * S, A * S, A * C), (S, 0, 0, C)),
    ("right wing 30 deg down, facing north", (C, S, 0, 0), (A * S, A * S, A * C, A * C)),
    ("upside down, facing east", (0, A, A, 0), (1, 0, 0, 0)),
]


def rotate(q_wxyz, v):
    w, u = q_wxyz[0], np.asarray(q_wxyz[1:])
    return v + 2 * w * np.cross(u, v) + 2 * np.cross(u, np.cross(u, v))


def same_rotation(p, q):
    return abs(abs(np.dot(p, q)) - 1.0) < EXACT


@pytest.mark.parametrize("seen, q_nb_wxyz, orientation_xyzw", ATTITUDES, ids=[row[0] for row in ATTITUDES])
def test_table_of_attitudes(seen, q_nb_wxyz, orientation_xyzw):
    assert same_rotation(frames.orientation_from_q_nb(q_nb_wxyz), orientation_xyzw)
    assert same_rotation(frames.q_nb_from_orientation(orientation_xyzw), q_nb_wxyz)


def test_specific_force_at_rest_points_up_in_both():
    np.testing.assert_array_equal(frames.swap_flu_frd([0, 0, 9.8]), [0, 0, -9.8])
    np.testing.assert_array_equal(frames.swap_flu_frd([1, 2, 3]), [1, -2, -3])


def test_world_axes():
    east, north, up = np.eye(3)
    np.testing.assert_array_equal(frames.swap_enu_ned(east), [0, 1, 0])
    np.testing.assert_array_equal(frames.swap_enu_ned(north), [1, 0, 0])
    np.testing.assert_array_equal(frames.swap_enu_ned(up), [0, 0, -1])


def test_an_orientation_takes_the_same_vector_to_the_same_place():
    rng = np.random.default_rng(0)
    q_nb = rng.normal(size=(50, 4))
    q_nb /= np.linalg.norm(q_nb, axis=1, keepdims=True)
    orientation = frames.orientation_from_q_nb(q_nb)
    v_b = rng.normal(size=(50, 3))
    for q, xyzw, v in zip(q_nb, orientation, v_b, strict=True):
        v_enu = rotate(np.roll(xyzw, 1), frames.swap_flu_frd(v))
        np.testing.assert_allclose(frames.swap_enu_ned(v_enu), rotate(q, v), atol=10 * EXACT)
    np.testing.assert_allclose(frames.q_nb_from_orientation(orientation), q_nb, atol=EXACT)


@pytest.mark.parametrize("swap, swap_covariance", [
    (frames.swap_flu_frd, frames.swap_flu_frd_covariance),
    (frames.swap_enu_ned, frames.swap_enu_ned_covariance)])
def test_covariances_follow_their_vectors(swap, swap_covariance):
    vectors = np.random.default_rng(1).normal(size=(4, 20, 3))
    covariance = np.einsum("kni,knj->kij", vectors, vectors)
    swapped = np.einsum("kni,knj->kij", swap(vectors), swap(vectors))
    np.testing.assert_allclose(swap_covariance(covariance), swapped, rtol=10 * EXACT)
    np.testing.assert_array_equal(swap_covariance(swap_covariance(covariance)), covariance)
    np.testing.assert_array_equal(swap(swap(vectors)), vectors)


def test_ros_pitch_is_nose_down_and_yaw_counts_from_east():
    rpy = frames.rpy_from_euler(0.1, 0.2, np.radians([0.0, 90.0, 180.0, 350.0]))
    np.testing.assert_allclose(np.degrees(rpy[:, 2]), [90.0, 0.0, -90.0, 100.0], atol=1e-12)
    np.testing.assert_array_equal(rpy[:, :2], [[0.1, -0.2]] * 4)

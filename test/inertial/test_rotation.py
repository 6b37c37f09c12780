"""Conventions, laws and closed forms of rotations."""

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from inertial import rotation

ROUNDING = 1e-14  # a few units in the last place of numbers near one
ROUND_TRIP = 1e-12  # rad; near pi the angle's cosine hides about two digits
COEFFICIENT_RELATIVE = 1e-15  # what filters may count on
QUADRATURE = 1e-12  # absolute error asked of the reference integrals
ANGLES = [0.0, 1e-9, 1.0, np.pi - 1e-6]


def _axes(count=20):
    axes = np.random.default_rng(1).standard_normal((count, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


@pytest.mark.parametrize("roll, pitch, down_b", [
    (0.0, 0.0, [0.0, 0.0, 1.0]),
    (0.0, 0.3, [-np.sin(0.3), 0.0, np.cos(0.3)]),
    (0.3, 0.0, [0.0, np.sin(0.3), np.cos(0.3)]),
    (np.pi, 0.0, [0.0, 0.0, -1.0]),
    (0.0, np.pi / 2, [-1.0, 0.0, 0.0]),
])
def test_down_of_level_nose_up_and_right_wing_down(roll, pitch, down_b):
    assert rotation.down_from_roll_pitch(roll, pitch) == pytest.approx(down_b, abs=ROUNDING)
    for heading in (0.0, 1.0, -2.5):
        dcm_nb = rotation.dcm_nb_from_euler(roll, pitch, heading)
        assert dcm_nb[2] == pytest.approx(down_b, abs=ROUNDING)


def test_heading_is_clockwise_from_north():
    nose_n = rotation.dcm_nb_from_euler(0.0, 0.0, np.pi / 2)[:, 0]
    assert nose_n == pytest.approx([0.0, 1.0, 0.0], abs=ROUNDING)


@pytest.mark.parametrize("length", [0.6, 1.0, 3.0])
def test_roll_and_pitch_do_not_depend_on_the_length_of_down(length):
    down_b = length * rotation.down_from_roll_pitch([2.5, -0.4], [-1.2, 0.9])
    roll, pitch = rotation.roll_pitch_from_down(down_b)
    assert roll == pytest.approx([2.5, -0.4], abs=ROUNDING)
    assert pitch == pytest.approx([-1.2, 0.9], abs=ROUNDING)


@pytest.mark.parametrize("pitch", [0.0, 1e-9, 1.0, -1.5, np.pi / 2, -np.pi / 2])
@pytest.mark.parametrize("roll", [0.0, 1e-9, -1.0, 3.0])
@pytest.mark.parametrize("heading", [0.0, 1.0, -3.0])
def test_euler_angles_rebuild_their_matrix_even_at_the_pole(roll, pitch, heading):
    dcm_nb = rotation.dcm_nb_from_euler(roll, pitch, heading)
    again = rotation.dcm_nb_from_euler(*rotation.euler_from_dcm(dcm_nb))
    assert again == pytest.approx(dcm_nb, abs=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_quaternion_exp_and_log_are_inverse(angle):
    vectors = angle * _axes()
    q = rotation.quaternion_exp(vectors)
    assert np.linalg.norm(q, axis=1) == pytest.approx(1.0, abs=ROUNDING)
    assert rotation.quaternion_log(q) == pytest.approx(vectors, abs=ROUND_TRIP)
    assert rotation.quaternion_log(-q) == pytest.approx(vectors, abs=ROUND_TRIP)


@pytest.mark.parametrize("angle", ANGLES)
def test_quaternion_and_matrix_are_the_same_rotation(angle):
    vectors = angle * _axes()
    q = rotation.quaternion_exp(vectors)
    expected = np.array([expm(matrix) for matrix in rotation.skew(vectors)])
    dcm = rotation.dcm_from_quaternion(q)
    assert dcm == pytest.approx(expected, abs=ROUNDING)
    assert rotation.quaternion_from_dcm(dcm) == pytest.approx(q, abs=ROUNDING)
    assert rotation.down_from_quaternion(q) == pytest.approx(dcm[:, 2], abs=ROUNDING)


@pytest.mark.parametrize("axis", np.eye(3))
def test_quaternion_of_a_half_turn(axis):
    q = rotation.quaternion_from_dcm(2 * np.outer(axis, axis) - np.eye(3))
    assert np.abs(q) == pytest.approx([0.0, *axis], abs=ROUNDING)


def test_quaternion_product_is_the_matrix_product():
    left, right = rotation.quaternion_exp(_axes() * 2.0), rotation.quaternion_exp(-_axes()[::-1])
    product = rotation.dcm_from_quaternion(rotation.quaternion_multiply(left, right))
    matrices = rotation.dcm_from_quaternion(left) @ rotation.dcm_from_quaternion(right)
    assert product == pytest.approx(matrices, abs=ROUNDING)
    identity = rotation.quaternion_multiply(left, rotation.quaternion_conjugate(left))
    assert identity == pytest.approx(np.tile([1.0, 0, 0, 0], (len(left), 1)), abs=ROUNDING)


def test_slerp_turns_at_constant_rate_the_short_way():
    start = rotation.quaternion_exp([0.3, -0.2, 0.1])
    vector = np.array([0.5, 1.0, -0.7])
    end = -rotation.quaternion_multiply(start, rotation.quaternion_exp(vector))
    fraction = np.array([0.0, 0.25, 1.0])
    expected = rotation.quaternion_multiply(
        start, rotation.quaternion_exp(fraction[:, None] * vector))
    found = rotation.quaternion_slerp(start, end, fraction)
    assert found == pytest.approx(expected, abs=ROUNDING)


def _coefficients_by_series(angle):
    """Taylor series summed in extended precision; good to 1e-17 for angles to 3."""
    square = np.longdouble(angle) ** 2
    sums = []
    for first in range(1, 5):
        term = np.longdouble(1) / np.prod(np.arange(1, first + 1, dtype=np.longdouble))
        total = term
        for k in range(1, 30):
            term = -term * square / ((first + 2 * k - 1) * (first + 2 * k))
            total += term
        sums.append(total)
    return sums


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.1, 1.0, 1.9999999, 2.0, 2.0000001, 3.0])
def test_zoh_coefficients_are_accurate_on_both_sides_of_the_cross_over(angle):
    for found, expected in zip(rotation.zoh_coefficients(angle), _coefficients_by_series(angle),
                               strict=True):
        assert abs(found - expected) <= COEFFICIENT_RELATIVE * expected


@pytest.mark.parametrize("angle", [4.0, 6.0, 20.0])
def test_zoh_coefficients_of_large_angles_are_the_closed_forms(angle):
    expected = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle ** 2,
                (angle - np.sin(angle)) / angle ** 3,
                (angle ** 2 / 2 + np.cos(angle) - 1) / angle ** 4)
    assert rotation.zoh_coefficients(angle) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_zoh_integrals_are_the_integrals_of_the_matrix_exponential(angle):
    dt = 0.7
    gyro_b = angle / dt * _axes(1)[0]
    W = rotation.skew(gyro_b)
    turn, first, second = rotation.zoh_integrals(gyro_b, dt)
    assert turn == pytest.approx(expm(W * dt), abs=ROUNDING)
    single = quad_vec(lambda t: expm(W * t), 0.0, dt, epsabs=QUADRATURE)[0]
    double = quad_vec(lambda t: (dt - t) * expm(W * t), 0.0, dt, epsabs=QUADRATURE)[0]
    assert first == pytest.approx(single, abs=QUADRATURE)
    assert second == pytest.approx(double, abs=QUADRATURE)

"""What the z gyro tells of the joint: sign, unit, delay, and when it tells nothing."""

import math

import numpy as np
import pytest

from alignment.joint_check import JointCheck

STEP = 0.01  # s between samples
DELAY = 1e-4  # s, without noise: the rate is no polynomial
RATIO = 1e-3


def _move(angle_of, seconds=4.0, delay=0.0, factor=1.0, gyro_factor=1.0):
    """Return time, joint angle in the middle and mean z rate of samples of a move."""
    time = STEP * np.arange(1, round(seconds / STEP) + 1)
    rate = (angle_of(time) - angle_of(time - STEP)) / STEP
    return time, factor * angle_of(time - 0.5 * STEP - delay), gyro_factor * rate


def _quarter(time):
    """Return the angle of a smooth quarter turn from second 1 to 3."""
    part = np.clip((time - 1.0) / 2.0, 0.0, 1.0)
    return 0.5 * math.pi * part ** 2 * (3 - 2 * part)


def _verdict(*moves):
    check = JointCheck()
    for move in moves:
        check.add(*move)
        check.end_move()
    return check.verdict()


@pytest.mark.parametrize("delay", [0.0, 0.05, -0.05])
def test_delay_and_ratio_of_a_good_joint(delay):
    verdict = _verdict(*[_move(_quarter, delay=delay)] * 3)
    assert verdict.ratio == pytest.approx(1.0, abs=RATIO + abs(delay) ** 2)
    assert verdict.delay == pytest.approx(delay, abs=DELAY + 0.02 * abs(delay))
    assert verdict.error == ""
    assert (verdict.warning != "") == (delay != 0.0)


@pytest.mark.parametrize("factor, gyro_factor, words", [
    (-1.0, 1.0, "counter-clockwise"), (180 / math.pi, 1.0, "is it in deg, not rad?"),
    (1.0, 180 / math.pi, "is the gyro in deg/s"), (-180 / math.pi, 1.0, "and clockwise?"),
    (0.5, 1.0, "is it the table's joint")])
def test_what_is_wrong_with_the_joint_is_named(factor, gyro_factor, words):
    assert words in _verdict(_move(_quarter, factor=factor, gyro_factor=gyro_factor)).error


def test_a_joint_that_does_not_follow_is_an_error():
    time, angle, gyro_z = _move(_quarter)
    assert "is it the table's joint" in _verdict((time, angle, np.roll(gyro_z, 150))).error


def test_steady_rotation_tells_the_ratio_but_no_delay():
    time, angle, gyro_z = _move(lambda t: 0.5 * t, seconds=20.0, delay=0.05)
    verdict = _verdict((time, angle, gyro_z + 1e-6 * np.random.default_rng(0).standard_normal(len(time))))
    assert verdict.ratio == pytest.approx(1.0, abs=RATIO)
    assert math.isnan(verdict.delay) and verdict.error == verdict.warning == ""


def test_before_a_move_nothing_is_known():
    verdict = _verdict(_move(lambda t: 0.01 * np.sin(t)))
    assert math.isnan(verdict.ratio) and verdict.error == verdict.warning == ""

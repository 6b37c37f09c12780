"""Units and sides up that are wrong are told; what a vehicle does is not mistaken for them."""

import numpy as np
import pytest

from inertial.scenarios import SCENARIOS
from inertial.simulator import simulate
from nav_ros.frames import swap_flu_frd
from nav_ros.imu_check import GRAVITY, ImuCheck

RATE = 50
TURNED_ABOUT = {"x": (1.0, -1.0, -1.0), "y": (-1.0, 1.0, -1.0)}


def looked_over(gyro, accel, up_imu=(0.0, 0.0, 1.0)):
    check = ImuCheck(up_imu)
    stamps = 10**18 + 10**9 // RATE * np.arange(len(gyro))
    for sample in zip(stamps.tolist(), gyro.tolist(), accel.tolist(), strict=True):
        check.add(*sample)
    return check


def simulated(scenario, duration=60.0):
    imu = simulate(scenario, duration=duration, imu_rate=RATE, seed=3).imu
    return swap_flu_frd(imu.gyro_b), swap_flu_frd(imu.accel_b)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_no_motion_is_mistaken_for_a_fault(scenario):
    assert looked_over(*simulated(scenario)).faults == {}


@pytest.mark.parametrize("factor, unit", [(1 / GRAVITY, "looks like g"), (1e3 / GRAVITY, "milli-g"), (1e3, "mm/s^2")])
@pytest.mark.parametrize("scenario", ["quad", "hover"])
def test_a_force_in_another_unit_is_named(scenario, factor, unit):
    gyro, accel = simulated(scenario, 20.0)
    (name, text), = looked_over(gyro, factor * accel).faults.items()
    assert name == "accel_unit" and unit in text and "multiply by" in text


@pytest.mark.parametrize("scenario", ["quad", "aerobatic"])
def test_rates_in_degrees_are_told(scenario):
    gyro, accel = simulated(scenario, 120.0)
    (name, text), = looked_over(np.degrees(gyro), accel).faults.items()
    assert name == "gyro_unit" and "deg/s" in text


@pytest.mark.parametrize("axis", TURNED_ABOUT)
def test_upside_down_at_rest_is_told_unless_it_is_meant(axis):
    gyro, accel = (vector * TURNED_ABOUT[axis] for vector in simulated("hover", 2.5))
    assert set(looked_over(gyro, accel).faults) == {"upside_down"}
    assert looked_over(gyro, accel, up_imu=(0.0, 0.0, -1.0)).faults == {}


def test_standing_is_neither_flying_nor_turning_steadily():
    still = looked_over(np.zeros((100, 3)), np.tile([0.0, 0.0, GRAVITY], (100, 1)))
    turning = looked_over(np.tile([0.0, 0.1, 0.3], (100, 1)), np.tile([0.0, 0.0, GRAVITY], (100, 1)))
    assert still.standing and not turning.standing
    assert not looked_over(*simulated("quad", 20.0)).standing


def test_values_that_are_not_finite_and_jumps_of_the_stamps_are_survived():
    gyro, accel = np.zeros((200, 3)), np.tile([0.0, 0.0, GRAVITY], (200, 1))
    gyro[50], accel[70] = np.nan, np.inf
    check = looked_over(gyro, accel)
    for stamp_ns in (5, 10**18, 3 * 10**18, 3 * 10**18 + 1):
        check.add(stamp_ns, (0.0, 0.0, 0.0), (0.0, 0.0, GRAVITY))
    assert check.faults == {}

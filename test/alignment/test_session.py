"""A whole alignment from simulated streams: heading, refusals with their reasons, methods, turning."""

import dataclasses
import itertools
import math
import re

import numpy as np
import pytest

from alignment.azimuth import METHODS
from alignment.params import AlignmentParams
from alignment.sequences import continuous_rotation
from alignment.session import TableSession, warm_up
from alignment.turntable import TriadErrors, Turntable, simulate_readings
from inertial.earth import normal_gravity
from inertial.rotation import dcm_nb_from_euler
from inertial.table_scenarios import HEADING, LATITUDE, PITCH, ROLL, TABLE_SCENARIOS, simulate_table

IMU_RATE = 25.0
SIGMAS = 4.0  # outside once in 16 000
DELAY = 0.005  # s, of a delay found from sixteen moves at 25 Hz
GRADE = TABLE_SCENARIOS["turntable_navigation"]
PARAMS = AlignmentParams(
    latitude=LATITUDE, gyro_noise_density=GRADE.errors.gyro_noise_density,
    gyro_bias_instability=GRADE.gyro_bias_instability, accel_noise_density=GRADE.errors.accel_noise_density,
    accel_bias_std=GRADE.errors.accel_bias_std, accel_scale_std=5e-5, scale_std=2e-5, skew_std=3e-5,
    table_zero_std=1e-5)


@pytest.fixture(scope="module")
def recording():
    return simulate_table("turntable_navigation", imu_rate=IMU_RATE, seed=5)


def run(recording, params=PARAMS, gyro=lambda gyro_b: gyro_b, accel=lambda accel_b: accel_b, **options):
    session = TableSession(params, **options)
    joints = dict(zip(recording.joint.stamp_ns.tolist(), recording.joint.angle.tolist(), strict=True))
    imu = recording.imu
    for stamp_ns, gyro_b, accel_b in zip(imu.stamp_ns.tolist(), gyro(imu.gyro_b), accel(imu.accel_b),
                                         strict=True):
        if stamp_ns in joints:
            session.add_joint(stamp_ns, joints[stamp_ns])
        session.add_imu(stamp_ns, gyro_b, accel_b)
    return session


def assert_aligned(session, heading=HEADING):
    assert session.refusal == ""
    level, north = session.result.level, session.result.north
    assert abs(math.remainder(float(north.heading) - heading, 2 * math.pi)) < SIGMAS * float(north.std)
    for found, truth, variance in zip((level.roll, level.pitch), (ROLL, PITCH), np.diag(level.covariance),
                                      strict=True):
        assert abs(found - truth) < SIGMAS * math.sqrt(variance)


@pytest.mark.parametrize("follow", [True, False])
def test_the_heading_of_a_simulated_table(recording, follow):
    session = run(recording, follow=follow)
    assert_aligned(session)
    assert len(session.dwells) == 8 and not session.rejected
    assert session.phase == "aligned"
    assert all(good for good, _ in session.take_remarks()) and session.take_remarks() == []
    assert math.degrees(session.result.north.std) < 0.1


def test_phases_as_the_table_goes_on(recording):
    session, phases = TableSession(PARAMS), []
    joint = zip(recording.joint.stamp_ns.tolist(), recording.joint.angle.tolist(), strict=True)
    next_joint = next(joint)
    for stamp_ns, gyro_b, accel_b in zip(recording.imu.stamp_ns.tolist(), recording.imu.gyro_b,
                                         recording.imu.accel_b, strict=True):
        changed = False
        while next_joint and next_joint[0] <= stamp_ns:
            changed |= session.add_joint(*next_joint)
            next_joint = next(joint, None)
        changed |= session.add_imu(stamp_ns, gyro_b, accel_b)
        if changed or not phases:
            phases.append(session.phase)
    assert [phase for phase, _ in itertools.groupby(phases)] == ["waiting", "coarse", "positions", "aligned"]


@pytest.mark.parametrize("latitude, reason", [
    (math.nan, "latitude is not known"), (math.pi / 2, "too near a pole"), (-math.pi / 2, "too near a pole")])
def test_without_a_usable_latitude_there_is_the_level_only(recording, latitude, reason):
    session = run(recording, dataclasses.replace(PARAMS, latitude=latitude, gravity=normal_gravity(LATITUDE)))
    assert reason in session.refusal and session.result.north is None and session.phase == "coarse"
    assert abs(session.result.level.roll - ROLL) < SIGMAS * math.sqrt(session.result.level.covariance[0, 0])
    session.params = PARAMS
    assert_aligned(session)


def test_sensors_in_other_units_are_named(recording):
    assert "in deg/s, not rad/s?" in run(recording, gyro=np.degrees).refusal
    assert "in g, not m/s^2?" in run(recording, accel=lambda accel_b: accel_b / 9.80665).refusal


@pytest.mark.parametrize("noisier, instability, reason", [
    (30.0, 0.0, "times as much as stated: gyro noise is (29|30|31)[.0-9]* times what gyro_noise_density says"),
    (1.0, 2e-6, "samples do not: the table or the IMU on it moves, or gyro_bias_instability is too small")])
def test_a_sensor_poorer_than_stated_is_told_by_what_was_measured(recording, noisier, instability, reason):
    """A sensor with more noise in every sample, and one whose bias differs from dwell to dwell."""
    rng = np.random.default_rng(3)

    def poorer(gyro_b):
        added = math.sqrt((noisier ** 2 - 1) * IMU_RATE) * PARAMS.gyro_noise_density
        slow = np.repeat(rng.standard_normal((8, 3)), math.ceil(len(gyro_b) / 8), axis=0)[:len(gyro_b)]
        return gyro_b + added * rng.standard_normal(gyro_b.shape) + instability * slow
    assert re.search(reason, run(recording, gyro=poorer).refusal)


def test_a_table_that_is_not_still_is_rejected_with_the_reason(recording):
    def rocking(accel_b):
        return accel_b + 0.01 * np.sin(0.05 * np.arange(len(accel_b)) / IMU_RATE * 2 * np.pi)[:, None]
    session = run(recording, accel=rocking)
    assert session.rejected and "accelerometer changed by" in session.rejected[0].rejection
    texts = [text for good, text in session.take_remarks() if not good]
    assert "rejected: not still" in texts[0]


def test_angles_that_are_all_the_same_are_refused_with_the_condition_number(recording):
    still = dataclasses.replace(recording, joint=dataclasses.replace(
        recording.joint, angle=np.zeros(len(recording.joint))))
    count = round(16.0 * IMU_RATE)
    imu = dataclasses.replace(recording.imu, gyro_b=np.tile(recording.imu.gyro_b[:count], (10, 1))[:len(recording.imu)],
                              accel_b=np.tile(recording.imu.accel_b[:count], (10, 1))[:len(recording.imu)])
    session = run(dataclasses.replace(still, imu=imu), follow=False)
    assert len(session.dwells) > 3 and "condition number" in session.refusal


def with_joint(recording, angle=None, delay_ns=0):
    """Return the recording with other joint angles and later stamps of theirs."""
    joint = recording.joint
    angle = joint.angle if angle is None else angle
    return dataclasses.replace(recording, joint=dataclasses.replace(
        joint, stamp_ns=joint.stamp_ns + delay_ns, angle=angle))


def test_a_joint_that_turns_the_wrong_way_is_named(recording):
    session = run(with_joint(recording, -recording.joint.angle))
    assert "must be counter-clockwise seen from above" in session.refusal
    assert [text for good, text in session.take_remarks() if not good] == [session.refusal]


def test_late_stamps_of_the_joint_are_told_and_do_no_harm_at_dwells(recording):
    session = run(with_joint(recording, delay_ns=80_000_000))
    assert_aligned(session)
    assert session.joint.delay == pytest.approx(0.08, abs=DELAY)
    assert any("stamps are" in text and "late" in text for _, text in session.take_remarks())
    known = run(with_joint(recording, delay_ns=80_000_000), dataclasses.replace(PARAMS, joint_delay=0.08))
    assert known.joint.delay == pytest.approx(0.0, abs=DELAY)


def test_stops_that_are_too_short_are_told(recording):
    session = run(recording, dataclasses.replace(PARAMS, dwell_time=80.0), follow=False)
    assert not session.dwells
    assert session.rejected[0].rejection.startswith("stood only 15.")
    assert session.rejected[0].rejection.endswith("s after settling; half of dwell_time, 40 s, is the least")


def test_a_table_that_has_moved_is_noticed(recording):
    count = round(120.0 * IMU_RATE)
    tilt = dcm_nb_from_euler(0.005, 0.0, 0.0)

    def moved(vector_b):
        return np.concatenate([vector_b[:count], vector_b[count:] @ tilt])
    twice = dataclasses.replace(recording, imu=repeated(recording.imu), joint=repeated(recording.joint))
    session = run(twice, gyro=moved, accel=moved)
    assert "has moved; begin anew" in session.refusal
    assert any("accelerometer is" in dwell.rejection for dwell in session.rejected)


def repeated(series):
    """Return a series twice, one after the other."""
    step_ns = series.stamp_ns[1] - series.stamp_ns[0]
    span_ns = series.stamp_ns[-1] - series.stamp_ns[0] + step_ns
    rest = {field.name: np.concatenate([getattr(series, field.name)] * 2) for field in dataclasses.fields(series)
            if field.name != "stamp_ns"}
    return type(series)(np.concatenate([series.stamp_ns, series.stamp_ns + span_ns]), **rest)


def test_a_latitude_without_its_sign_is_doubted(recording):
    session = run(recording, dataclasses.replace(PARAMS, latitude=-LATITUDE))
    assert "is the sign of the latitude right?" in session.doubt
    assert session.refusal
    assert run(recording).doubt == ""


def test_other_methods_and_what_they_lack(recording):
    chosen = run(recording, dataclasses.replace(PARAMS, method="azimuth_4", levelling="levelling_1"))
    assert_aligned(chosen)
    joint = run(recording)
    levels, headings = joint.compare()
    assert float(chosen.result.north.heading) == pytest.approx(float(headings["azimuth_4"].heading), abs=1e-5)
    assert set(levels) == {"joint", *(f"levelling_{k}" for k in range(1, 6))}
    assert set(headings) == {"joint", *METHODS}
    count = round(54.0 * IMU_RATE)
    early = dataclasses.replace(recording, imu=dataclasses.replace(
        recording.imu, stamp_ns=recording.imu.stamp_ns[:count], gyro_b=recording.imu.gyro_b[:count],
        accel_b=recording.imu.accel_b[:count]))
    session = run(early, dataclasses.replace(PARAMS, method="azimuth_1b"))
    assert len(session.dwells) == 3 and "azimuth_1b lacks a position" in session.refusal


def test_dwells_after_a_stop_follow_those_before(recording):
    session = TableSession(PARAMS, follow=False)
    half = len(recording.imu) // 2
    joints = dict(zip(recording.joint.stamp_ns.tolist(), recording.joint.angle.tolist(), strict=True))
    for k, stamp_ns in enumerate(recording.imu.stamp_ns.tolist()):
        if k == half:
            session.stop()
        if k == half + round(IMU_RATE):
            session.start()
        if stamp_ns in joints:
            session.add_joint(stamp_ns, joints[stamp_ns])
        session.add_imu(stamp_ns, recording.imu.gyro_b[k], recording.imu.accel_b[k])
    assert len(session.dwells) == 8 and not session.rejected
    assert_aligned(session)


def test_stop_start_and_reset(recording):
    session = run(recording)
    session.stop()
    assert session.phase == "stopped"
    before = len(session.dwells)
    assert not session.add_imu(1, np.zeros(3), np.zeros(3)) and len(session.dwells) == before
    session.reset()
    session.start()
    assert session.phase == "waiting" and session.wanted == 0.0 and not session.dwells


def test_a_table_that_turns_both_ways_is_recognised():
    table = Turntable(ROLL, PITCH, HEADING, LATITUDE, float(normal_gravity(LATITUDE)))
    schedule = continuous_rotation(math.radians(20.0), 120.0, 0.02)
    readings = simulate_readings(table, schedule, TriadErrors(noise_density=PARAMS.gyro_noise_density),
                                 TriadErrors(noise_density=PARAMS.accel_noise_density),
                                 np.random.default_rng(1))
    session = TableSession(PARAMS)
    # The angle is known when each sample ends, the reading is the interval's mean.
    at_end = schedule.angle + 0.5 * schedule.rate * schedule.duration
    for time, angle, gyro_b, accel_b in zip(schedule.end, at_end, readings.gyro_b, readings.accel_b,
                                            strict=True):
        stamp_ns = 10**18 + round(time * 1e9)
        session.add_joint(stamp_ns, angle)
        session.add_imu(stamp_ns, gyro_b, accel_b)
    session.finish()
    assert session.turning and not session.dwells
    assert session.phase in ("rotation", "aligned")
    assert_aligned(session)


def test_warm_up_needs_no_latitude():
    warm_up(dataclasses.replace(PARAMS, latitude=math.nan))

"""Streams of samples and table angles to dwells, or to the samples of a table that keeps turning."""

import math

import numpy as np
import pytest

from alignment.collector import DwellCollector, columns_of
from alignment.params import AlignmentParams

RATE_NS = 20_000_000  # between samples
START_NS = 1_700_000_000_000_000_000
PARAMS = AlignmentParams(dwell_time=4.0, settle_time=0.5, gyro_noise_density=1e-6, accel_noise_density=1e-4)
ANGLE_ROUNDING = 1e-12  # rad
SAMPLE = 0.021  # s: one interval and a rounding
QUARTER = 0.5 * math.pi


def track(*parts):
    """Return angles at every sample of parts (seconds, angle at the end); the first is the start."""
    angles = [np.full(1, parts[0])]
    for seconds, angle in parts[1:]:
        angles.append(np.linspace(angles[-1][-1], angle, round(seconds * 1e9 / RATE_NS) + 1)[1:])
    return np.concatenate(angles)


def feed(collector, angles, joint_delay=0, spoil=None):
    """Feed angles and still sensors; the joints `joint_delay` samples late. Return the dwells."""
    rng = np.random.default_rng(3)
    dwells = []
    for k in range(len(angles) + joint_delay):
        if k < len(angles):
            stamp_ns = START_NS + k * RATE_NS
            sample = 1e-6 * rng.standard_normal(3), [0, 0, -9.8] + 1e-4 * rng.standard_normal(3)
            if spoil is None or spoil(k):
                dwells += collector.add_imu(stamp_ns, *sample)
        if 0 <= k - joint_delay < len(angles):
            dwells += collector.add_joint(START_NS + (k - joint_delay) * RATE_NS, angles[k - joint_delay])
    return dwells


def test_a_dwell_begins_when_the_table_has_settled():
    angles = track(0.0, (5.0, 0.0), (2.0, QUARTER), (5.0, QUARTER))
    dwells = feed(DwellCollector(PARAMS), angles)
    assert [dwell.angle for dwell in dwells] == pytest.approx([0.0, QUARTER], abs=ANGLE_ROUNDING)
    assert [dwell.rejection for dwell in dwells] == ["", ""]
    assert dwells[0].start == pytest.approx(0.5, abs=SAMPLE)
    assert dwells[1].start == pytest.approx(7.5, abs=2 * SAMPLE)
    for dwell in dwells:
        assert dwell.duration == pytest.approx(PARAMS.dwell_time, abs=2 * SAMPLE)


@pytest.mark.parametrize("joint_delay", [1, 50, 200])
def test_joints_that_come_late_count_at_their_stamps(joint_delay):
    angles = track(0.0, (5.0, 0.0), (2.0, QUARTER), (5.0, QUARTER))
    expected, found = (feed(DwellCollector(PARAMS), angles, delay) for delay in (0, joint_delay))
    assert [(dwell.start, dwell.end) for dwell in found] == [(dwell.start, dwell.end) for dwell in expected]
    np.testing.assert_array_equal([dwell.gyro_b for dwell in found], [dwell.gyro_b for dwell in expected])


def test_samples_without_an_angle_are_counted_and_dropped():
    collector = DwellCollector(PARAMS)
    for k in range(1000):
        collector.add_imu(START_NS + k * RATE_NS, [0, 0, 0], [0, 0, -9.8])
    assert collector.lost > 0 and collector.partial() is None


def test_samples_that_are_not_numbers_or_not_later_are_left_out_and_counted():
    class Spoilt(DwellCollector):
        def add_imu(self, stamp_ns, gyro_b, accel_b):
            k = (stamp_ns - START_NS) // RATE_NS
            return super().add_imu(stamp_ns - RATE_NS * (k % 100 == 50),
                                   [math.nan, 0.0, 0.0] if k % 100 == 0 else gyro_b, accel_b)

    collector = Spoilt(PARAMS)
    (dwell,) = feed(collector, track(0.0, (5.0, 0.0)))
    assert collector.refused == 6 and dwell.rejection == ""
    assert np.isfinite([dwell.gyro_b, dwell.accel_b]).all()


def test_an_encoder_that_wraps_has_not_moved():
    angles = track(math.pi, (5.0, math.pi))
    angles[::2] -= 2 * math.pi
    (dwell,) = feed(DwellCollector(PARAMS), angles)
    assert dwell.rejection == "" and abs(math.remainder(dwell.angle - math.pi, 2 * math.pi)) < ANGLE_ROUNDING


def test_a_table_that_stays_is_waited_for_when_another_angle_is_wanted():
    angles = track(0.0, (20.0, 0.0))
    assert len(feed(DwellCollector(PARAMS), angles)) == 4
    collector = DwellCollector(PARAMS)
    collector.wanted = QUARTER
    assert len(feed(collector, angles)) == 1
    collector = DwellCollector(PARAMS)
    collector.wanted = 2 * math.pi  # the same place
    assert len(feed(collector, angles)) == 4


def test_dwells_that_follow_each_other_do_not_overlap():
    dwells = feed(DwellCollector(PARAMS), track(0.0, (20.0, 0.0)))
    assert all(before.end <= after.start for before, after in zip(dwells, dwells[1:], strict=False))


@pytest.mark.parametrize("seconds, count", [(1.5, 0), (3.5, 1)])
def test_a_stop_counts_from_half_a_dwell_on(seconds, count):
    angles = track(0.0, (seconds, 0.0), (2.0, QUARTER))
    assert len(feed(DwellCollector(PARAMS), angles)) == count


def test_a_gap_in_the_samples_ends_the_dwell():
    collector = DwellCollector(PARAMS)
    angles = track(0.0, (9.0, 0.0))
    dwells = feed(collector, angles, spoil=lambda k: not 100 <= k < 140)  # 2 s to 2.8 s
    assert collector.gaps == 1
    assert [dwell.start for dwell in dwells] == pytest.approx([2.8 + PARAMS.settle_time], abs=3 * SAMPLE)


def test_turning_is_recognised_after_a_full_turn_and_rocking_is_not():
    collector = DwellCollector(PARAMS)
    feed(collector, track(0.0, (2.0, 0.0), (4.0, 1.9 * math.pi)))
    assert not collector.turning
    collector = DwellCollector(PARAMS)
    feed(collector, track(0.0, (2.0, 0.0), *[(2.0, QUARTER), (2.0, 0.0)] * 10))
    assert not collector.turning
    collector = DwellCollector(PARAMS)
    angles = track(0.0, (2.0, 0.0), (10.0, 5 * math.pi), (1.0, 5 * math.pi), (10.0, 0.0))
    assert feed(collector, angles) == []
    blocks = collector.take_turning(last=True)
    assert len(blocks) > 3 and collector.take_turning(last=True) == []
    time, angle, gyro_b, accel_b = columns_of(np.concatenate(blocks))
    assert np.ptp(time) == pytest.approx(21.0, abs=3 * SAMPLE)
    assert np.ptp(angle) == pytest.approx(5 * math.pi, rel=0.01)
    assert gyro_b.shape == accel_b.shape == (len(time), 3)
    rate = np.gradient(angle, time)
    assert min(np.mean(rate > 0), np.mean(rate < 0)) > 0.4


def test_a_table_that_rocks_for_ever_keeps_no_samples():
    collector = DwellCollector(PARAMS)
    feed(collector, track(0.0, (1.0, 0.0), *[(0.5, QUARTER), (0.5, 0.0)] * 100))
    assert collector.take_turning(last=True) == []
    assert len(collector._moving) < 100


def test_reset_forgets_everything():
    collector = DwellCollector(PARAMS)
    feed(collector, track(0.0, (2.0, 0.0), (4.0, 3 * math.pi)))
    collector.reset()
    assert not collector.turning and math.isnan(collector.angle) and collector.partial() is None

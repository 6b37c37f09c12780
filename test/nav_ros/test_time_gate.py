"""The time gate: every kind of stamp, one by one and all at once."""

import math

import numpy as np
import pytest

from nav_ros.time_gate import StampCode as C
from nav_ros.time_gate import TimeGate, TimeGateParams, classify_stamps, gate_state

T0 = 1_700_000_000_000_000_001
DT = 10_000_000


def codes_of(stamps, **params):
    gate = TimeGate(TimeGateParams(**params))
    return [C(gate.check(stamp)) for stamp in stamps], gate


def clean(n, start=T0, dt=DT):
    return [start + k * dt for k in range(n)]


def test_a_clean_run_has_only_steps():
    codes, gate = codes_of(clean(200))
    assert codes == [C.FIRST] + [C.STEP] * 199
    assert gate.dt_ns == DT and gate.period_ns == DT and not gate.interleaved


def test_jitter_of_a_third_of_the_period_is_no_gap():
    jitter = np.random.default_rng(0).integers(-DT // 6, DT // 6, 500)
    codes, _ = codes_of([stamp + int(j) for stamp, j in zip(clean(500), jitter, strict=True)])
    assert set(codes[1:]) == {C.STEP}


@pytest.mark.parametrize("offset, code", [
    (0, C.DUPLICATE), (-1, C.BACKWARD), (-500_000_000, C.BACKWARD), (-500_000_001, C.JUMP_BACK),
    (DT, C.STEP), (15_000_000, C.STEP), (15_000_001, C.GAP), (1_000_000_000, C.GAP),
    (1_000_000_001, C.LONG_GAP)])
def test_each_threshold_to_the_nanosecond(offset, code):
    stamps = clean(100)
    codes, gate = codes_of([*stamps, stamps[-1] + offset])
    assert codes[-1] == code
    assert gate.counts[code] == (1 if code != C.STEP else 100)
    used = code < C.DUPLICATE
    assert gate.stamp_ns == (stamps[-1] + offset if used else stamps[-1])
    assert gate.dt_ns == (offset if code in (C.STEP, C.GAP) else 0 if used else DT)


@pytest.mark.parametrize("stamp", [0, -1, -10**18])
def test_without_a_stamp_a_sample_is_refused_or_given_the_fixed_interval(stamp):
    codes, _ = codes_of([stamp, T0, stamp, T0 + DT])
    assert codes == [C.NO_STAMP, C.FIRST, C.NO_STAMP, C.STEP]
    codes, gate = codes_of([stamp] * 4, fixed_dt=0.01)
    assert codes == [C.FIRST, C.STEP, C.STEP, C.STEP]
    assert gate.stamp_ns == 4 * DT and gate.dt_ns == DT


def test_the_counters_equal_the_faults_injected():
    stamps = clean(1000)
    faulty = stamps[:100] + [stamps[99]] * 3 + stamps[100:300] + [stamps[290], stamps[295]] \
        + stamps[300:400] + [0] + stamps[420:600] + stamps[800:] + stamps
    _, gate = codes_of(faulty)
    assert dict(zip(C, gate.counts, strict=True)) == {
        C.FIRST: 1, C.DUPLICATE: 3, C.BACKWARD: 2, C.NO_STAMP: 1, C.GAP: 1, C.LONG_GAP: 1, C.JUMP_BACK: 1,
        C.STEP: len(faulty) - 10}
    assert not gate.interleaved


def test_two_publishers_with_an_offset_are_told():
    stamps = [stamp for pair in zip(clean(20), clean(20, T0 - 3_000_000), strict=True) for stamp in pair]
    _, gate = codes_of(stamps)
    assert gate.interleaved


def test_two_publishers_with_different_clocks_are_told():
    stamps = [stamp for pair in zip(clean(20), clean(20, 5_000_000_000), strict=True) for stamp in pair]
    _, gate = codes_of(stamps)
    assert gate.interleaved


def test_after_the_second_publisher_has_gone_the_fault_clears():
    both = [stamp for pair in zip(clean(50), clean(50, T0 - 3_000_000), strict=True) for stamp in pair]
    _, gate = codes_of(both + clean(300, T0 + 50 * DT))
    assert not gate.interleaved


def random_stamps(seed, n=2000):
    rng = np.random.default_rng(seed)
    steps = np.where(rng.random(n) < 0.9, DT, rng.choice([0, -DT, -10**9, 3 * DT, 2 * 10**9], n))
    return np.where(rng.random(n) < 0.01, 0, T0 + np.cumsum(steps))


@pytest.mark.parametrize("params", [TimeGateParams(), TimeGateParams(fixed_dt=0.01)])
@pytest.mark.parametrize("seed", range(3))
def test_all_at_once_equals_one_by_one(params, seed):
    stamps = random_stamps(seed)
    gate, expected, used = TimeGate(params), [], []
    for stamp in stamps.tolist():
        expected.append(gate.check(stamp))
        used.append(gate.stamp_ns if expected[-1] < C.DUPLICATE else stamp)
    codes, used_ns = classify_stamps(stamps, params)
    assert codes.tolist() == expected and used_ns.tolist() == used
    assert set(expected) >= set(C) - {C.NO_STAMP}


def test_a_run_may_be_cut_into_pieces():
    stamps, params, state = random_stamps(5), TimeGateParams(), gate_state()
    whole, _ = classify_stamps(stamps, params)
    parts = [classify_stamps(part, params, state)[0] for part in np.array_split(stamps, 7)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_a_stamp_far_from_the_clock_is_told_with_its_offset():
    gate = TimeGate(TimeGateParams())
    assert gate.clock_fault(T0, T0 - 1_000_000_000) is None
    assert gate.clock_fault(T0 + 2_500_000_000, T0) == "stamps are 2.500 s ahead of the node's clock"
    assert gate.clock_fault(T0, T0 + 3_000_000_000) == "stamps are 3.000 s behind the node's clock"


def test_other_thresholds_serve_from_the_next_stamp():
    gate = TimeGate(TimeGateParams())
    gate.check(T0)
    gate.set_params(TimeGateParams(backward_tolerance=0.0))
    assert gate.check(T0 - 1) == C.JUMP_BACK


@pytest.mark.parametrize("name, value", [("gap_limit", math.nan), ("gap_limit", 0.0), ("fixed_dt", -0.01)])
def test_thresholds_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        TimeGateParams(**{name: value})

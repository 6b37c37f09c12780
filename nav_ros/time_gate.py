"""What to do with a sample, judged by its stamp alone, in whole nanoseconds.

==============  ======================================================================  ==================
code            stamp                                                                   the sample is
==============  ======================================================================  ==================
``STEP``        the usual interval after the last one                                   used
``GAP``         more than ``gap_periods`` usual intervals later, within ``gap_limit``   used, in sub-steps
``FIRST``       the first one                                                           a start
``LONG_GAP``    later by more than ``gap_limit``                                        a new start
``JUMP_BACK``   earlier by more than ``backward_tolerance``: a bag's loop, a clock set  a new start
``DUPLICATE``   the last one again                                                      refused
``BACKWARD``    earlier, within the tolerance                                           refused
``NO_STAMP``    zero or not a time, and no ``fixed_dt`` to stand in                     refused
==============  ======================================================================  ==================

A held rate is never integrated over a long gap. Stamps that keep going back and forth are those of two
publishers on one topic (``interleaved``). One compiled function decides, for a node's samples as they come
and for a whole bag's.
"""

import enum
import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from inertial.parameters import check_parameters, parameter


class StampCode(enum.IntEnum):
    """See the module's table; codes from ``DUPLICATE`` on refuse the sample."""

    STEP = 0
    GAP = 1
    FIRST = 2
    LONG_GAP = 3
    JUMP_BACK = 4
    DUPLICATE = 5
    BACKWARD = 6
    NO_STAMP = 7


@dataclass(frozen=True)
class TimeGateParams:
    """Thresholds of the time gate."""

    backward_tolerance: float = parameter(
        0.5, "s", "A stamp earlier than the last one by no more than this is dropped; further back resets",
        0.0, 60.0)
    gap_limit: float = parameter(
        1.0, "s", "Longest forward gap to propagate through; beyond it the estimator starts anew", 0.01, 60.0)
    gap_periods: float = parameter(
        1.5, "", "Intervals longer than this many usual ones count as gaps", 1.1, 100.0)
    fixed_dt: float = parameter(
        math.nan, "s", "Interval given to samples without a stamp", 1e-5, 1.0,
        nan_means="samples without a stamp are refused")
    clock_tolerance: float = parameter(
        1.0, "s", "Stamps further than this from the node's clock give a warning", 0.0, 1e9)

    def __post_init__(self):
        check_parameters(self)


_STEP, _GAP, _FIRST, _LONG_GAP, _JUMP_BACK, _DUPLICATE, _BACKWARD, _NO_STAMP = map(int, StampCode)
_LAST, _DT, _PERIOD, _INTERVALS, _DISORDER = range(5)
_STATE_SIZE = 5
_PERIOD_SAMPLES = 50
# Each step out of order weighs ten in order, so a tenth of the stamps out of order tells two publishers.
_DISORDER_WEIGHT, _DISORDER_LIMIT, _DISORDER_MAX = 10, 100, 200


@njit(cache=True)
def _disorder(state):
    state[_DISORDER] = min(state[_DISORDER] + _DISORDER_WEIGHT, _DISORDER_MAX)


@njit(cache=True)
def classify_stamp(stamp_ns, limits, state):
    """Return the code of one stamp.

    Parameters
    ----------
    stamp_ns : int
        Zero or negative where there is none.
    limits : (4,) int64
        From :func:`gate_limits`.
    state : (5,) int64
        From :func:`gate_state`; changed in place. ``state[0]`` is the stamp of the last sample used,
        ``state[1]`` the interval before it in ns, zero at a start.
    """
    backward, gap_limit, gap_permille, fixed_dt = limits
    if stamp_ns <= 0:
        if fixed_dt == 0:
            return _NO_STAMP
        stamp_ns = state[_LAST] + fixed_dt
    dt = stamp_ns - state[_LAST]
    if state[_LAST] == 0:
        code = _FIRST
    elif dt == 0:
        return _DUPLICATE
    elif dt < 0 and dt >= -backward:
        _disorder(state)
        return _BACKWARD
    elif dt < 0:
        code = _JUMP_BACK
        _disorder(state)
    elif dt > gap_limit:
        code = _LONG_GAP
        _disorder(state)
    else:
        gap = state[_INTERVALS] > 0 and 1000 * dt > gap_permille * state[_PERIOD]
        code = _GAP if gap else _STEP
        state[_INTERVALS] = min(state[_INTERVALS] + 1, _PERIOD_SAMPLES)
        if state[_INTERVALS] == 1:
            state[_PERIOD] = dt
        state[_PERIOD] += (min(dt, 2 * state[_PERIOD]) - state[_PERIOD]) // state[_INTERVALS]
        state[_DISORDER] = max(state[_DISORDER] - 1, 0)
    state[_LAST] = stamp_ns
    state[_DT] = dt if code <= _GAP else 0
    return code


@njit(cache=True)
def _classify_all(stamp_ns, limits, state, codes, used_ns):
    for k in range(len(stamp_ns)):
        codes[k] = classify_stamp(stamp_ns[k], limits, state)
        used_ns[k] = state[_LAST] if codes[k] < _DUPLICATE else stamp_ns[k]


def gate_limits(params):
    """Return the thresholds as (4,) int64: ns, ns, thousandths of a period, ns (0 = none)."""
    fixed_dt = 0 if math.isnan(params.fixed_dt) else round(params.fixed_dt * 1e9)
    return np.array([round(params.backward_tolerance * 1e9), round(params.gap_limit * 1e9),
                     round(params.gap_periods * 1000), fixed_dt], np.int64)


def gate_state():
    """Return the state before the first sample, (5,) int64."""
    return np.zeros(_STATE_SIZE, np.int64)


def classify_stamps(stamp_ns, params, state=None):
    """Classify many stamps in the order received, exactly as :class:`TimeGate` does one by one.

    Parameters
    ----------
    stamp_ns : (N,) int64
    params : TimeGateParams
    state : (5,) int64, optional
        From :func:`gate_state` or an earlier call; changed in place.

    Returns
    -------
    codes : (N,) int8
        Of :class:`StampCode`.
    used_ns : (N,) int64
        The stamps, with those that ``fixed_dt`` made up filled in.
    """
    stamp_ns = np.ascontiguousarray(stamp_ns, np.int64)
    codes, used_ns = np.empty(len(stamp_ns), np.int8), np.empty(len(stamp_ns), np.int64)
    _classify_all(stamp_ns, gate_limits(params), gate_state() if state is None else state, codes, used_ns)
    return codes, used_ns


class TimeGate:
    """Judges the stamps of one topic as they come and counts what it finds.

    Attributes
    ----------
    counts : list of int
        How often each :class:`StampCode` was given.
    """

    def __init__(self, params):
        self._limits = gate_limits(params)
        self._clock_tolerance_ns = round(params.clock_tolerance * 1e9)
        self._state = gate_state()
        self.counts = [0] * len(StampCode)

    def check(self, stamp_ns):
        """Return the code of the next stamp, as an int that equals a :class:`StampCode`."""
        code = classify_stamp(stamp_ns, self._limits, self._state)
        self.counts[code] += 1
        return code

    def set_params(self, params):
        """Use other thresholds from the next stamp on."""
        self._limits = gate_limits(params)
        self._clock_tolerance_ns = round(params.clock_tolerance * 1e9)

    @property
    def stamp_ns(self):
        """Stamp of the last sample used, made up from ``fixed_dt`` if it had none; 0 before the first."""
        return int(self._state[_LAST])

    @property
    def dt_ns(self):
        """Interval before the last sample used, ns; 0 at a start."""
        return int(self._state[_DT])

    @property
    def period_ns(self):
        """Running mean of the interval, ns; 0 while unknown."""
        return int(self._state[_PERIOD])

    @property
    def interleaved(self):
        """Whether stamps keep going back and forth, as those of two publishers do."""
        return bool(self._state[_DISORDER] >= _DISORDER_LIMIT)

    def clock_fault(self, stamp_ns, now_ns):
        """Return what is wrong between a stamp and the node's clock, or None."""
        offset_ns = stamp_ns - now_ns
        if abs(offset_ns) <= self._clock_tolerance_ns:
            return None
        side = "ahead of" if offset_ns > 0 else "behind"
        return f"stamps are {abs(offset_ns) * 1e-9:.3f} s {side} the node's clock"

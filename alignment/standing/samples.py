"""Samples of an IMU, one by one or many at a time, to the steps that the filters take.

What is no number or not later than the sample before is left out and counted; a gap begins a new step. A filter of
the error model runs on samples, so that each step comes with those that it was made of where they are wanted.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.standing import _kernels as kernels
from inertial.recording import ImuSeries

_LONGEST_GAP = 1.0  # s without a sample, after which the alignment starts anew


@dataclass(frozen=True)
class Samples:
    """Samples with the intervals that end at their stamps: (N,) ns and s, (N, 3) rad/s and m/s^2."""

    stamp_ns: np.ndarray
    dt: np.ndarray
    gyro_b: np.ndarray
    accel_b: np.ndarray

    @classmethod
    def none(cls):
        """Return no samples."""
        return cls(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))

    @classmethod
    def of(cls, rows):
        """Return the samples of rows (stamp, interval, rate, force)."""
        values = np.array([row[1:] for row in rows])
        return cls(np.array([row[0] for row in rows], dtype=np.int64), values[:, 0], values[:, 1:4], values[:, 4:])

    def joined(self, later):
        """Return these and later samples."""
        if not len(self.dt):
            return later
        return Samples(*(np.concatenate([getattr(self, name), getattr(later, name)])
                         for name in ("stamp_ns", "dt", "gyro_b", "accel_b")))

    def part(self, start, end):
        """Return the samples from start to end."""
        return Samples(self.stamp_ns[start:end], self.dt[start:end], self.gyro_b[start:end], self.accel_b[start:end])


@dataclass(frozen=True)
class Steps:
    """Steps that have been completed.

    Attributes
    ----------
    values : (K, STEP_SIZE) float64
    stamp_ns : (K,) int64
        At which each ends.
    spans : tuple of K Samples
        What each was made of; none where nobody wants it.
    gap : float, s
        Length of a gap before them, 0 for none.
    """

    values: np.ndarray
    stamp_ns: np.ndarray
    spans: tuple = ()
    gap: float = 0.0


class StepMaker:
    """Makes steps of samples.

    Attributes
    ----------
    period : float, s
        Shortest length of a step.
    with_spans : bool
        Whether each step comes with its samples.
    refused, gaps : int
        Samples that were not numbers or not later than the one before; gaps.
    """

    def __init__(self):
        self.period, self.with_spans = 0.0, False
        self.refused = self.gaps = 0
        self.reset()

    def reset(self):
        """Forget every sample."""
        self._stamp_ns = None
        self._one = Samples(np.zeros(1, dtype=np.int64), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))
        self._one_step, self._one_end = np.empty((1, kernels.STEP_SIZE)), np.empty(1, dtype=np.int64)
        self._begin_step()

    def _begin_step(self):
        self._step = np.zeros(kernels.A_SIZE)
        self._held, self._singles = Samples.none(), []

    @property
    def noise_density(self):
        """Density of the white noise that the samples of rate and force show, (6,), rad/s and m/s^2 per root hertz."""
        return np.sqrt(self._step[kernels.A_NOISE:kernels.A_BEFORE])

    def add_one(self, stamp_ns, gyro_b, accel_b):
        """Take in a sample, rad/s and m/s^2; return the :class:`Steps` that it completes, in a sequence."""
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        if not (0.0 < dt <= _LONGEST_GAP and math.isfinite(sum(gyro_b) + sum(accel_b))):
            return self.add(ImuSeries(np.array([stamp_ns], dtype=np.int64), np.array([gyro_b], dtype=float),
                                      np.array([accel_b], dtype=float)))
        self._stamp_ns = stamp_ns
        one = self._one
        one.stamp_ns[0], one.dt[0], one.gyro_b[0], one.accel_b[0] = stamp_ns, dt, gyro_b, accel_b
        if self.with_spans:
            self._singles.append((stamp_ns, dt, *gyro_b, *accel_b))
        return self._reduce(one, single=True)

    def add(self, imu):
        """Take in an ImuSeries; yield the :class:`Steps` that it completes."""
        stamp_ns, gyro_b, accel_b = self._usable(imu)
        if not len(stamp_ns):
            return
        if self._stamp_ns is None:
            self._stamp_ns = int(stamp_ns[0])
            stamp_ns, gyro_b, accel_b = stamp_ns[1:], gyro_b[1:], accel_b[1:]
        dt = np.diff(stamp_ns, prepend=self._stamp_ns) * 1e-9
        if len(stamp_ns):
            self._stamp_ns = int(stamp_ns[-1])
        gaps = np.flatnonzero(dt > _LONGEST_GAP)
        edges = sorted({0, *gaps.tolist(), len(dt)})
        for start, end in zip(edges[:-1], edges[1:], strict=True):
            if start in gaps:
                self.gaps += 1
                self._begin_step()
                yield Steps(np.empty((0, kernels.STEP_SIZE)), np.empty(0, dtype=np.int64), gap=float(dt[start]))
                start += 1
            yield from self._reduce(Samples(stamp_ns[start:end], dt[start:end], gyro_b[start:end],
                                            accel_b[start:end]))

    def _usable(self, imu):
        """Return stamps, rates and forces of the samples that are numbers and later than those before."""
        good = np.isfinite(imu.gyro_b).all(axis=1) & np.isfinite(imu.accel_b).all(axis=1)
        last = -1 << 62 if self._stamp_ns is None else self._stamp_ns
        before = np.maximum.accumulate(np.concatenate([[last], np.where(good, imu.stamp_ns, last)]))[:-1]
        good &= imu.stamp_ns > before
        self.refused += int(np.sum(~good))
        return imu.stamp_ns[good], imu.gyro_b[good], imu.accel_b[good]

    def _reduce(self, samples, single=False):
        """Return the steps that samples complete; a single one is among the singles already."""
        size = len(samples.dt)
        steps, ends = (self._one_step, self._one_end) if size == 1 else (
            np.empty((size, kernels.STEP_SIZE)), np.empty(size, dtype=np.int64))
        count = kernels.reduce_samples(self._step, samples.dt, samples.gyro_b, samples.accel_b, self.period, steps,
                                       ends)
        if not self.with_spans:
            return [Steps(steps[:count].copy(), samples.stamp_ns[ends[:count]])] if count else []
        if single and not count:
            return []
        return [self._with_samples(steps[:count].copy(), ends[:count], samples, single)]

    def _with_samples(self, steps, ends, samples, single):
        """Return steps with their samples, and hold those of the step under way."""
        if self._singles:
            self._held = self._held.joined(Samples.of(self._singles))
            self._singles = []
        ends = ends + len(self._held.dt) - (len(samples.dt) if single else 0)
        every = self._held if single else self._held.joined(samples)
        edges = [0, *(ends + 1)]
        spans = tuple(every.part(start, end) for start, end in zip(edges[:-1], edges[1:], strict=True))
        self._held = every.part(edges[-1], len(every.dt))
        return Steps(steps, every.stamp_ns[ends], spans)

"""An alignment of a standing vehicle from a stream of samples: what ``alignment_node`` and ``align_bag`` run.

It gives :class:`alignment.standing.aligner.StandingAligner` the shape of :class:`alignment.session.TableSession`:
it can be stopped and started, may get its latitude later, and runs every method over a recording.
"""

import dataclasses
import math

import numpy as np

from alignment.standing.aligner import StandingAligner
from alignment.standing.params import STANDING_METHODS
from inertial.recording import ImuSeries

# Samples are handed over by blocks, which costs a fraction of one by one; no result comes more often.
_BLOCK_NS = 100_000_000
_COMPARED = 10  # blocks handed over at a time where only the end matters
# m/s, more than a vehicle that turns on the spot reaches.
_DRIVEN = 1.0
# These know errors about rest only, and cannot take back the zero velocities of a vehicle that crept off unnoticed.
_LOST_BY_A_DRIVE = ("ipekf", "ekf5", "ekf10", "ukf10")


class StandingSession:
    """Level and heading of a vehicle at rest from an IMU, sample by sample.

    Parameters
    ----------
    params : alignment.standing.params.StandingParams
    keep : bool
        Whether the samples are kept, as those of a recording, for :meth:`compare`.

    Attributes
    ----------
    running : bool
        While it is false samples are ignored.
    """

    def __init__(self, params, keep=False):
        self._blocks = [] if keep else None
        self._block, self._driven = [], False
        self._aligner = StandingAligner(params)
        self._phase = self._aligner.phase
        self._remarks = []
        self.running = True

    @property
    def params(self):
        """Parameters; the alignment starts anew with others."""
        return self._aligner.params

    @params.setter
    def params(self, params):
        self._aligner.params = params

    def reset(self):
        """Forget everything that was measured."""
        self._block, self._driven = [], False
        self._aligner.reset()

    def stop(self):
        """Ignore what comes until :meth:`start`; return whether the phase has changed."""
        changed = self.finish() or self.running
        self.running = False
        return changed

    def start(self):
        """Take in samples; from the beginning if it was stopped, because the vehicle may have moved."""
        if not self.running:
            self.reset()
        self.running = True

    def finish(self):
        """Take in what has come; return whether the phase has changed."""
        if not self._block:
            return False
        stamps, gyro_b, accel_b = zip(*self._block, strict=True)
        imu = ImuSeries(np.array(stamps), np.array(gyro_b), np.array(accel_b))
        self._block = []
        if self._blocks is not None:
            self._blocks.append(imu)
        return self._take(imu)

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take in a sample, rad/s and m/s^2; return whether the phase has changed."""
        if not self.running:
            return False
        self._block.append((stamp_ns, gyro_b, accel_b))
        return abs(stamp_ns - self._block[0][0]) >= _BLOCK_NS and self.finish()

    def take_remarks(self):
        """Return what has happened since the last call, each as (good, text)."""
        remarks, self._remarks = self._aligner.take_remarks() + self._remarks, []
        return remarks

    @property
    def result(self):
        """The :class:`alignment.standing.results.StandingResult` so far, or None."""
        return self._aligner.result

    @property
    def phase(self):
        """One of stopped, waiting, coarse, fine, aligned."""
        return self._aligner.phase if self.running else "stopped"

    @property
    def activity(self):
        """What the vehicle and the alignment are doing, in words."""
        return self._aligner.activity if self.running else "stopped: call ~/start"

    @property
    def refusal(self):
        """Why there is no heading, or why it must not be believed; empty when it may be."""
        return self._aligner.refusal

    @property
    def input_error(self):
        """What is wrong with the samples, as a unit or a scale; empty when they may be of a vehicle on the Earth."""
        return self._aligner.input_error

    @property
    def gaps(self):
        """Gaps in the samples."""
        return self._aligner.gaps

    @property
    def refused(self):
        """Samples that were not numbers or not later than the one before."""
        return self._aligner.refused

    def compare(self):
        """Return what every method finds in the kept samples: a dict, method to session."""
        others = {name: StandingSession(dataclasses.replace(self.params, method=name))
                  for name in STANDING_METHODS if name != self.params.method}
        for start in range(0, len(self._blocks), _COMPARED):
            imu = _joined(self._blocks[start:start + _COMPARED])
            for session in others.values():
                session._take(imu)
        return {name: others.get(name, self) for name in STANDING_METHODS}

    def _take(self, imu):
        self._aligner.run(imu)
        self._watch_drive()
        before, self._phase = self._phase, self._aligner.phase
        if self._phase == "aligned" != before:
            heading, std = math.degrees(self.result.heading) % 360.0, math.degrees(self.result.heading_std)
            self._remarks.append((True, f"aligned: heading {heading:.3f} +- {std:.3f} deg"))
        return self._phase != before

    def _watch_drive(self):
        """Begin anew where a drive ends that the method does not bear; a turn on the spot every one does."""
        aligner = self._aligner
        if self.params.method not in _LOST_BY_A_DRIVE:
            return
        if aligner.moving:
            result = aligner.result
            self._driven |= result is not None and np.linalg.norm(result.velocity_n) > _DRIVEN
        elif self._driven:
            self._remarks.append((False, "the vehicle has driven: the alignment starts anew"))
            self._driven = False
            aligner.reset()


def _joined(blocks):
    return ImuSeries(*(np.concatenate([getattr(block, name) for block in blocks])
                       for name in ("stamp_ns", "gyro_b", "accel_b")))

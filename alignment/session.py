"""An alignment on a turntable from streams of samples: what ``alignment_node`` and ``align_bag`` run.

It joins :class:`alignment.collector.DwellCollector`, :class:`alignment.station.TableAlignment` and
:class:`alignment.rotation.SteadyRotation`, chooses between these two and the method, and says why there is no
heading when there is none.
"""

import dataclasses
import math
from collections import deque

import numpy as np

from alignment.azimuth import METHODS
from alignment.collector import DwellCollector, columns_of
from alignment.dwells import Dwell
from alignment.errors import NotEnoughDataError
from alignment.joint_check import JointVerdict
from alignment.reasons import doubt_latitude, explain_heading, explain_level, sign_matters
from alignment.results import SINGULAR_SENSITIVITY
from alignment.rotation import SteadyRotation
from alignment.sequences import FOUR_POSITIONS
from alignment.station import TableAlignment
from alignment.turntable import Turntable, exact_readings

_PREVIEW = 1.0  # s of standing from which a first level is given
_FEWEST_ANGLES = 3
_NO_LATITUDE = "the latitude is not known: level only"


class TableSession:
    """Level and heading of a turntable from its angle and an IMU, sample by sample.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
    follow : bool
        Whether a table that stands where it has had its dwell is waited for until it turns to the wanted
        angle; otherwise every dwell counts, as of a recording.

    Attributes
    ----------
    result : alignment.station.AlignmentResult or None
        None until the first second at rest; later of the parameters' method.
    joint : alignment.joint_check.JointVerdict
        What the moves tell of the joint.
    running : bool
        While it is false samples are ignored.
    """

    def __init__(self, params, follow=True):
        self._follow = follow
        self._station, self._rotation = TableAlignment(params), SteadyRotation(params)
        self._collector = DwellCollector(params)
        self.running = True
        self._remarks = []
        self.reset()
        self.params = params

    @property
    def params(self):
        """Parameters; the result changes with them."""
        return self._params

    @params.setter
    def params(self, params):
        self._params = params
        near_pole = math.cos(params.latitude) < SINGULAR_SENSITIVITY
        self._no_latitude = ""
        if near_pole:
            self._no_latitude = (f"latitude {math.degrees(params.latitude):.3f} deg is too near a pole for a "
                                 "heading: level only")
        elif math.isnan(params.latitude):
            self._no_latitude = _NO_LATITUDE
        used = dataclasses.replace(params, latitude=math.nan) if near_pole else params
        self._station.params = self._rotation.params = self._collector.params = used
        self._solve()

    def reset(self):
        """Forget everything that was measured."""
        self._station.reset()
        self._rotation.reset()
        self._collector.reset()
        self._blocks = deque()
        self._told, self._preview_at = set(), _PREVIEW
        self.result, self._source, self._missing = None, None, ""
        self.joint = JointVerdict()
        self.wanted = self._next_angle()

    def stop(self):
        """Take in the dwell under way, if it is long enough, and ignore what comes until :meth:`start`."""
        changed = self.finish()
        self.running = False
        self._collector.pause()
        return changed

    def start(self):
        """Take in samples."""
        self.running = True

    def finish(self):
        """Take in the dwell under way and the last turning; return whether the result has changed."""
        return self._add(self._collector.finish()) | self._turn(last=True)

    def add_joint(self, stamp_ns, angle):
        """Take in the table's angle, rad; return whether the result has changed."""
        return self.running and self._add(self._collector.add_joint(stamp_ns, angle))

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take in a sample, rad/s and m/s^2; return whether the result has changed."""
        if not self.running:
            return False
        changed = self._add(self._collector.add_imu(stamp_ns, gyro_b, accel_b))
        return changed | self._turn() | self._preview()

    def take_remarks(self):
        """Return what has been accepted and rejected since the last call, each as (good, text)."""
        remarks, self._remarks = self._remarks, []
        return remarks

    @property
    def dwells(self):
        """The accepted dwells."""
        return self._station.dwells

    @property
    def rejected(self):
        """The rejected dwells."""
        return tuple(self._station.rejected)

    @property
    def turning(self):
        """Whether the result is that of a table that turns steadily."""
        return self._source is self._rotation

    @property
    def table_angle(self):
        """Last table angle, rad, NaN before the first."""
        return self._collector.angle

    @property
    def lost(self):
        """Samples without an angle, or angles without samples."""
        return self._collector.lost

    @property
    def gaps(self):
        """Gaps in the samples."""
        return self._collector.gaps

    @property
    def refused(self):
        """Samples that were not numbers or not later than the one before."""
        return self._collector.refused

    @property
    def phase(self):
        """One of stopped, waiting, coarse, positions, rotation, aligned."""
        if not self.running:
            return "stopped"
        if self.result is None:
            return "waiting"
        if self.result.north is None:
            return "coarse"
        if not self.refusal and self.result.north.std <= self.params.target_std:
            return "aligned"
        return "rotation" if self.turning else "positions"

    @property
    def activity(self):
        """What the table and the sensors are doing, in words."""
        collector = self._collector
        if math.isnan(collector.angle):
            return "no angle of the table yet"
        if collector.elapsed:
            return f"dwell of {collector.elapsed:.1f} s, {self.params.dwell_time:g} s wanted"
        if not collector.still:
            return "the table turns or has not settled"
        return f"waits for table angle {math.degrees(self.wanted):.2f} deg, clockwise"

    @property
    def refusal(self):
        """Why there is no heading, or why it must not be believed; empty when it may be."""
        if self.result is None:
            return f"no dwell to be used yet: {self.rejected[-1].rejection}" if self.rejected \
                else "the table has not stood still yet"
        level, north = self.result.level, self.result.north
        wrong = self.joint.error or explain_level(level) or self._station.moved or self._no_latitude
        if wrong:
            return wrong
        if north is None:
            return self._missing or self._too_few
        one_way = self.turning and not self._rotation.both_ways
        noise_ratio = math.nan if self.turning else self._station.noise_ratio
        told = explain_heading(north, level, self.params.latitude, one_way, noise_ratio)
        return told or (self.doubt if sign_matters(level, float(north.std), self.params.latitude) else "")

    @property
    def doubt(self):
        """What speaks against the latitude's sign; empty when nothing does."""
        result = self.result
        if result is None or result.north is None or np.isnan(result.north.heading):
            return ""
        return doubt_latitude(result.gyro_bias, result.level, float(result.north.heading), self.params.latitude)

    @property
    def _too_few(self):
        if len(self.dwells) < _FEWEST_ANGLES:
            return f"{len(self.dwells)} of at least {_FEWEST_ANGLES} table angles so far"
        return self.result.reason

    def compare(self, names=METHODS, levels=True):
        """Return levels and headings by every method that can be had: two dicts, name to result.

        Parameters
        ----------
        names : iterable of str
            Heading methods wanted.
        levels : bool
            Whether all levelling methods are wanted, and not only the joint one.

        Raises
        ------
        NotEnoughDataError
            No dwell yet.
        """
        source = self._source or self._station
        levels = source.compare_levels() if levels else {"joint": source.result().level}
        headings = {} if self._no_latitude else source.compare_headings(levels.get(self.params.levelling), names)
        return levels, headings

    def _add(self, dwells):
        for dwell in dwells:
            rejected = len(self.rejected)
            if not self._station.add(dwell):
                self._remarks.append((True, f"dwell {len(self.dwells)} {_where(dwell)}: {dwell.duration:.1f} s, "
                                            f"{dwell.kept:.1%} of the samples"))
            self._remarks += [(False, f"dwell {_where(bad)} rejected: {bad.rejection}")
                              for bad in self.rejected[rejected:]]
        if not dwells:
            return False
        self._solve()
        self.wanted = self._next_angle()
        return True

    def _next_angle(self):
        wanted = self._station.next_angle()
        self._collector.wanted = wanted if self._follow else None
        return wanted

    def _preview(self):
        """Give the level of the first seconds; a later dwell is better."""
        if self.result is not None or self._collector.elapsed < self._preview_at:
            return False
        self._preview_at = self._collector.elapsed + _PREVIEW
        first = TableAlignment(self._station.params)
        if first.add(self._collector.partial()):
            return False
        self.result = first.result()
        self._missing = "no dwell yet"
        return True

    def _turn(self, last=False):
        """Take in what has come of steady turning, a block at a time, and solve it when there is no more."""
        self._blocks += self._collector.take_turning(last)
        if not self._blocks:
            return False
        if not self._rotation.started:
            self._rotation.start(*columns_of(np.concatenate(self._blocks)))
        for _ in range(len(self._blocks) if last else 1):
            self._rotation.add(*columns_of(self._blocks.popleft()))
        return not self._blocks and self._solve()

    def _solve(self):
        """Take the better of what the dwells and what the steady turning tell; return whether there is any."""
        self.joint = joint = self._collector.joint_check.verdict()
        self._tell("joint error", joint.error)
        self._tell("joint warning", joint.warning)
        self._rotation.delay_seen = 0.0 if math.isnan(joint.delay) else abs(joint.delay)
        best = None
        for source in (self._station, self._rotation):
            try:
                found = source.result()
            except NotEnoughDataError:
                continue
            if best is None or _deviations(found) < _deviations(best[0]):
                best = found, source
        if best is None:
            return False
        found, self._source = best
        self.result, self._missing = self._by_method(found)
        self._tell("latitude", self.doubt)
        return True

    def _tell(self, kind, text):
        """Remark a text of each kind once."""
        if text and kind not in self._told:
            self._told.add(kind)
            self._remarks.append((False, text))

    def _by_method(self, found):
        """Return the result with level and heading by the parameters' methods, and what these lack."""
        method, levelling = self.params.method, self.params.levelling
        if method == levelling == "joint" or found.north is None:
            return found, ""
        levels, headings = self.compare([method], levels=levelling != "joint")
        lacking = [name for name, there in ((levelling, levels), (method, headings)) if name not in there]
        if lacking:
            missing = f"{lacking[0]} lacks a position: the sequence goes on"
            return dataclasses.replace(found, north=None), missing
        north = headings[method]
        time_left = 0.0 if north.std <= self.params.target_std else math.nan
        if method == "joint":
            north, time_left = found.north, found.time_left
        return dataclasses.replace(found, level=levels[levelling], north=north, time_left=time_left), ""


def _deviations(found):
    """Return the heading's deviation, infinite where there is none, and the level's: the better result has the less."""
    north = found.north
    there = north is not None and np.isfinite(north.std)
    return float(north.std) if there else math.inf, float(np.trace(found.level.covariance))


def _where(dwell):
    return f"at {math.degrees(dwell.angle) % 360:.2f} deg"


def warm_up(params):
    """Solve a made-up alignment once, so that no later one waits for a compiler.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
    """
    station = TableAlignment(dataclasses.replace(params, latitude=0.5))
    readings = exact_readings(Turntable(latitude=0.5, heading=1.0), np.array(FOUR_POSITIONS))
    for k, angle in enumerate(FOUR_POSITIONS):
        station.add(Dwell(angle, float(k), k + 1.0, readings.gyro_b[k], readings.accel_b[k]))
    station.result()


"""The two kinds of alignment in one shape: what ``alignment_node`` and ``align_bag`` tell of either.

A view holds a session, :class:`alignment.session.TableSession` or
:class:`alignment.standing_session.StandingSession`, and words its state: solution, status, what to do next.
Degrees are in the names.

A ROS joint about z (up) is counter-clockwise, a table angle clockwise: ``tau = -joint``.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.errors import AlignmentError
from alignment.session import TableSession
from alignment.session import warm_up as warm_up_table
from alignment.standing.aligner import warm_up as warm_up_standing
from alignment.standing.params import STANDING_METHODS
from alignment.standing_session import StandingSession
from inertial.earth import STANDARD_GRAVITY

_DEG_PER_HOUR = math.radians(1.0) / 3600.0
_MILLI_G = 1e-3 * STANDARD_GRAVITY


@dataclass(frozen=True)
class Solution:
    """What is published of an alignment.

    Attributes
    ----------
    roll, pitch : float, rad
    believable : bool
        Whether the rest may be published; where it is false the rest is NaN.
    heading, heading_var : float, rad and rad^2
    covariance_n : (3, 3) float64, rad^2
        Of a small rotation about north, east and down.
    stamp_ns : int or None
        When the attitude was that; None: it does not change.
    """

    roll: float
    pitch: float
    believable: bool = False
    heading: float = math.nan
    heading_var: float = math.nan
    covariance_n: np.ndarray | None = None
    stamp_ns: int | None = None


def open_view(params, live=True):
    """Return a new alignment by the parameters' method.

    Parameters
    ----------
    params : alignment.edge.AlignmentNodeParams
    live : bool
        Whether somebody follows what is wanted next; otherwise it is a recording.

    Returns
    -------
    TableView or StandingView
    """
    view = StandingView if params.method in STANDING_METHODS else TableView
    return view(params, live)


def joint_position(angle):
    """Return the joint's position of a table angle, rad."""
    return 0.0 - angle  # no negative zero


class TableView:
    """An alignment on a turntable; parameters as in :func:`open_view`.

    Attributes
    ----------
    session : alignment.session.TableSession
    """

    inputs = ("joints", "imu")
    """Keys of :data:`nav_ros.bags.TOPICS`; of messages that wait together, those of the first come first."""
    setback = "disturbed"
    """Name of the counter of what has gone wrong."""

    def __init__(self, params, live=True):
        self.session = TableSession(params, follow=live)
        if live:
            warm_up_table(params)

    def check(self, params):
        """Raise ValueError for parameters that this alignment cannot change to."""
        if params.method in STANDING_METHODS:
            raise ValueError(f"method = {params.method!r}: is for a standing vehicle; start anew with it")

    @property
    def solution(self):
        """The :class:`Solution` so far, or None."""
        result = self.session.result
        if result is None or not math.isfinite(result.level.roll):
            return None
        level, north = result.level, result.north
        roll, pitch = float(level.roll), float(level.pitch)
        if self.session.refusal:
            return Solution(roll, pitch)
        # Level and heading count as independent.
        covariance = np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = level.covariance, north.variance
        turns_n = _rotation_of_angles(pitch, float(north.heading))
        return Solution(roll, pitch, True, float(north.heading), float(north.variance),
                        turns_n @ covariance @ turns_n.T)

    @property
    def lack(self):
        """Why there is no solution."""
        rejected = self.session.rejected
        return f"no usable dwell: {rejected[0].rejection if rejected else 'the table did not stand long enough'}"

    @property
    def wanted_joint(self):
        """The joint's position that is wanted, rad, or None."""
        return joint_position(self.session.wanted) if self.session.running else None

    @property
    def next_step(self):
        """What to do next."""
        if not self.session.running:
            return "stopped: call ~/start"
        return f"turn the joint to {self.wanted_joint:.6f} rad ({math.degrees(self.wanted_joint):.2f} deg)"

    @property
    def gathered(self):
        """How much has been measured."""
        return f"{len(self.session.dwells)} dwells"

    @property
    def bad_input(self):
        """Whether it is the input that forbids a heading."""
        result = self.session.result
        return result is not None and bool(self.session.refusal) and (
            bool(result.level.flags) or result.north is not None and not result.believable)

    def status(self):
        """Return key -> value of what is known."""
        session, params, result = self.session, self.session.params, self.session.result
        values = {"phase": session.phase, "method": params.method, "levelling": params.levelling,
                  "sequence": params.sequence, "dwells": len(session.dwells),
                  "dwells_rejected": len(session.rejected)}
        if result is None:
            return values
        level, north = result.level, result.north
        values |= _level_row(level) | {"accel_scale": float(level.scale), "accel_bias": float(level.bias)}
        if north is None:
            return values
        return values | {
            "heading_deg": math.degrees(north.heading) % 360.0, "heading_sigma_deg": math.degrees(north.std),
            "heading_floor_deg": math.degrees(result.floor),
            "target_sigma_deg": math.degrees(params.target_std), "time_to_target_s": float(result.time_left),
            "gyro_bias_deg_h": math.degrees(north.bias) * 3600.0, "gyro_scale": float(north.scale),
            "chi2": float(north.chi2), "believable": not session.refusal,
            "flags": _flag_names(north.flags | level.flags)}

    def activity(self):
        """Return key -> value of what is going on."""
        session = self.session
        values = {"table": session.activity, "joint_rad": joint_position(session.table_angle),
                  "next_joint_rad": joint_position(session.wanted)}
        if session.rejected:
            values["last_rejection"] = session.rejected[-1].rejection
        values |= {"joint_per_gyro_turn": session.joint.ratio, "joint_delay_s": session.joint.delay}
        return values | {"gaps": session.gaps, "samples_without_angle": session.lost,
                         "samples_refused": session.refused}

    def findings(self):
        """Return key -> value of what else a whole recording tells, every method's result among it."""
        session = self.session
        values = {"refusal": session.refusal, "turning": session.turning,
                  "rejections": [dwell.rejection for dwell in session.rejected],
                  "levelling_methods": {}, "heading_methods": {}}
        if session.dwells:
            try:
                levels, headings = session.compare()
            except AlignmentError:
                return values
            values["levelling_methods"] = {
                name: _level_row(level) | {"flags": _flag_names(level.flags)} for name, level in levels.items()}
            values["heading_methods"] = {name: _heading_row(north) for name, north in headings.items()}
        return values

    def remarks(self):
        """Return (title, text) of what a person should read besides the result."""
        session = self.session
        dwells = f"{len(session.dwells)} used, {len(session.rejected)} rejected"
        return [("dwells", dwells + "; the table turns steadily" * session.turning),
                *(("rejected", dwell.rejection) for dwell in session.rejected),
                *((title, text) for title, text in (("joint", session.joint.warning), ("latitude", session.doubt))
                  if text),
                ("flags", self.status().get("flags", "none"))]


class StandingView:
    """An alignment of a standing vehicle; parameters as in :func:`open_view`.

    Attributes
    ----------
    session : alignment.standing_session.StandingSession
    """

    inputs = ("imu",)
    setback = "interrupted"
    wanted_joint = None

    def __init__(self, params, live=True):
        self.session = StandingSession(params, keep=not live)
        if live:
            warm_up_standing(params)

    def check(self, params):
        """Raise ValueError for parameters that this alignment cannot change to."""
        if params.method not in STANDING_METHODS:
            raise ValueError(f"method = {params.method!r}: is for a turntable; start anew with it")

    @property
    def solution(self):
        """The :class:`Solution` so far, or None."""
        result = self.session.result
        if result is None:
            return None
        if self.session.refusal:
            return Solution(result.roll, result.pitch, stamp_ns=result.stamp_ns)
        return Solution(result.roll, result.pitch, True, result.heading, result.heading_std ** 2,
                        result.covariance, result.stamp_ns)

    @property
    def lack(self):
        """Why there is no solution."""
        return self.session.refusal

    @property
    def next_step(self):
        """What to do next."""
        session = self.session
        if not session.running:
            return "stopped: call ~/start"
        if session.phase == "fine" and math.isinf(session.result.time_left):
            return (f"turn the vehicle or the IMU by half a turn: standing like this, "
                    f"{math.degrees(session.result.floor):.3g} deg is the floor")
        return "keep the vehicle still"

    @property
    def gathered(self):
        """How much has been measured."""
        return f"phase {self.session.phase}"

    @property
    def bad_input(self):
        """Whether it is the input that forbids a heading."""
        return bool(self.session.input_error)

    def status(self):
        """Return key -> value of what is known; biases are those forward, right and down."""
        session, result = self.session, self.session.result
        values = {"phase": session.phase, "method": session.params.method}
        if result is None:
            return values
        return values | _result_row(result) | {
            "target_sigma_deg": math.degrees(session.params.target_std),
            "time_to_target_s": float(result.time_left), "believable": not session.refusal,
            **_axis_rows("gyro_bias", "deg_h", result.gyro_bias_b / _DEG_PER_HOUR),
            **_axis_rows("gyro_bias_sigma", "deg_h", result.gyro_bias_std / _DEG_PER_HOUR),
            **_axis_rows("accel_bias", "mg", result.accel_bias_b / _MILLI_G),
            **_axis_rows("accel_bias_sigma", "mg", result.accel_bias_std / _MILLI_G),
            "speed": float(np.linalg.norm(result.velocity_n)), "cost": float(result.cost)}

    def activity(self):
        """Return key -> value of what is going on."""
        session = self.session
        return {"vehicle": session.activity, "next_step": self.next_step, "gaps": session.gaps,
                "samples_refused": session.refused}

    def findings(self):
        """Return key -> value of what else a whole recording tells, every method's result among it."""
        return {"refusal": self.session.refusal, "heading_methods": {
            name: {"phase": session.phase} | _result_row(session.result)
            for name, session in self.session.compare().items() if session.result is not None}}

    def remarks(self):
        """Return (title, text) of what a person should read besides the result."""
        session, result = self.session, self.session.result
        lines = [("phase", session.phase), ("next", self.next_step)]
        if np.isfinite(result.gyro_bias_std).all():
            gyro = _listed(result.gyro_bias_b / _DEG_PER_HOUR, result.gyro_bias_std / _DEG_PER_HOUR)
            accel = _listed(result.accel_bias_b / _MILLI_G, result.accel_bias_std / _MILLI_G)
            lines += [("biases", f"of the gyros forward, right, down: {gyro} deg/h"),
                      ("", f"of the accelerometers: {accel} mg")]
        return lines


def _result_row(result):
    stds = np.degrees(_angle_stds(result))
    return {"roll_deg": math.degrees(result.roll), "roll_sigma_deg": float(stds[0]),
            "pitch_deg": math.degrees(result.pitch), "pitch_sigma_deg": float(stds[1]),
            "heading_deg": math.degrees(result.heading) % 360.0,
            "heading_sigma_deg": math.degrees(result.heading_std),
            "heading_floor_deg": math.degrees(result.floor), "nis": float(result.nis)}


def _angle_stds(result):
    """Return the deviations of roll, pitch and heading."""
    angles = np.linalg.inv(_rotation_of_angles(result.pitch, result.heading))
    return np.sqrt(np.diag(angles @ result.covariance @ angles.T))


def _axis_rows(name, unit, values):
    return {f"{name}_{axis}_{unit}": float(value) for axis, value in zip("xyz", values, strict=True)}


def _listed(values, stds):
    return ", ".join(f"{value:.4g} +- {std:.2g}" for value, std in zip(values, stds, strict=True))


def _level_row(level):
    roll_std, pitch_std = np.sqrt(np.diag(level.covariance))
    return {"roll_deg": math.degrees(level.roll), "roll_sigma_deg": math.degrees(roll_std),
            "pitch_deg": math.degrees(level.pitch), "pitch_sigma_deg": math.degrees(pitch_std)}


def _heading_row(north):
    return {"heading_deg": math.degrees(north.heading) % 360.0, "sigma_deg": math.degrees(north.std),
            "gyro_bias_deg_h": math.degrees(north.bias) * 3600.0, "gyro_scale": float(north.scale),
            "flags": _flag_names(north.flags)}


def _flag_names(flags):
    return ", ".join(flag.name for flag in type(flags) if flag in flags) or "none"


def _rotation_of_angles(pitch, heading):
    """Return the matrix that takes changes of roll, pitch and heading to a small rotation in NED."""
    sp, cp, sh, ch = math.sin(pitch), math.cos(pitch), math.sin(heading), math.cos(heading)
    return np.array([[cp * ch, -sh, 0.0], [cp * sh, ch, 0.0], [-sp, 0.0, 1.0]])

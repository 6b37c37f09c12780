"""What faults of a turntable and disturbances of a standing vehicle do to the heading, one at a time.

``python3 -m studies.disturbances`` writes docs/results/disturbances.md. The turntable is that of
:mod:`inertial.table_scenarios` or one that turns steadily, with one fault put into the streams or into what the
finder is told. The vehicle is a sprung body on the turning Earth: its angles and the path of the IMU are given, and the
readings are the rate and force that these make. Frames and units as in :mod:`inertial`.
"""

import argparse
import dataclasses
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alignment.params import AlignmentParams
from alignment.sequences import continuous_rotation
from alignment.session import TableSession
from alignment.standing.aligner import StandingAligner
from alignment.turntable import TriadErrors, Turntable, simulate_readings
from inertial.earth import STANDARD_GRAVITY, earth_rate_n, normal_gravity
from inertial.imu_errors import apply_imu_errors
from inertial.parked_scenarios import GRADES as PARKED_GRADES
from inertial.recording import ImuSeries, JointSeries
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
)
from inertial.table_scenarios import HEADING, LATITUDE, PITCH, ROLL, TABLE_SCENARIOS, simulate_table
from studies import head_commit
from studies.north_finding import table
from studies.standing_runs import ARCMINUTE, DEG, DEG_PER_HOUR, each, root_mean, told, wrap

OUT = Path("docs/results")
SEEDS = 8  # vehicles of each disturbance
WORKERS = 2
TABLE_SEED = 5
TABLE_TIME = 296.0  # s, two rounds
TABLE_RATE = 25.0  # Hz
TURNING_RATE = 6 * DEG
VEHICLE_TIME = 300.0  # s
VEHICLE_RATE = 50.0  # Hz
OVERSAMPLING = 4  # of the vehicle's motion, of which the IMU reads means
MARKS = (60.0, VEHICLE_TIME)  # s at which the heading is looked at


def main(argv=None):
    """Write the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the results")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="vehicles of each disturbance")
    parser.add_argument("--workers", type=int, default=min(WORKERS, os.cpu_count() or 1), help="processes")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Faults of a turntable, disturbances of a vehicle", "",
        f"Made by `python3 -m studies.disturbances` from commit {head_commit()}, seed "
        f"{TABLE_SEED} for the table, seeds 0 to {arguments.seeds - 1} for the vehicles; latitude "
        f"{LATITUDE / DEG:.0f} deg. One fault at a time, of the size named; error over sigma beyond 4 means that the "
        "finder is wrong and does not know it.", "",
        *table_section(arguments.workers), "", *vehicle_section(arguments.seeds, arguments.workers)]
    (arguments.out / "disturbances.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(arguments.out / "disturbances.md")


# --- turntable ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Streams:
    """What comes from a turntable, and what the finder is told."""

    imu: ImuSeries
    joint: JointSeries
    params: AlignmentParams


@dataclass(frozen=True)
class Fault:
    """A fault: its name, what it makes of the streams, and how the table goes (dwells, one way, both ways)."""

    name: str
    spoil: Callable = lambda streams, rng: streams
    way: str = "dwells"
    stand: dict = dataclasses.field(default_factory=dict)


def _told(**changes):
    return lambda streams, rng: dataclasses.replace(streams, params=dataclasses.replace(streams.params, **changes))


def _imu(change):
    """Return a fault of the readings: ``change(seconds, gyro_b, accel_b, rng)`` returns the two as they arrive."""
    def spoil(streams, rng):
        imu = streams.imu
        readings = change((imu.stamp_ns - imu.stamp_ns[0]) * 1e-9, imu.gyro_b.copy(), imu.accel_b.copy(), rng)
        return dataclasses.replace(streams, imu=ImuSeries(imu.stamp_ns, *readings))
    return spoil


def _gyro(change):
    return _imu(lambda t, gyro_b, accel_b, rng: (change(t, gyro_b, rng), accel_b))


def _joint(change):
    """Return a fault of the joint: ``change(seconds, angle)`` returns the angle as it arrives."""
    def spoil(streams, rng):
        joint = streams.joint
        angle = change((joint.stamp_ns - joint.stamp_ns[0]) * 1e-9, joint.angle)
        return dataclasses.replace(streams, joint=JointSeries(joint.stamp_ns, angle))
    return spoil


def _late(delay):
    """Return a fault: the joint's stamps are late by so many s."""
    return lambda streams, rng: dataclasses.replace(streams, joint=JointSeries(
        streams.joint.stamp_ns + round(1e9 * delay), streams.joint.angle))


def _lost(imu_share=0.0, joint_share=0.0, gap=(0.0, 0.0)):
    """Return a fault: so many samples or angles are lost at random, or all of a time."""
    def spoil(streams, rng):
        imu, joint = streams.imu, streams.joint
        t = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
        kept = (rng.random(len(imu)) >= imu_share) & ~((t >= gap[0]) & (t < gap[1]))
        there = rng.random(len(joint)) >= joint_share
        return dataclasses.replace(streams, imu=ImuSeries(imu.stamp_ns[kept], imu.gyro_b[kept], imu.accel_b[kept]),
                                   joint=JointSeries(joint.stamp_ns[there], joint.angle[there]))
    return spoil


def _turned(vectors_b, angle):
    """Return vectors as seen by a body turned by so much about z."""
    return vectors_b @ dcm_nb_from_euler(0.0, 0.0, angle)


def _moved(t, gyro_b, accel_b, rng):
    late = t > 0.55 * TABLE_TIME
    for readings in (gyro_b, accel_b):
        readings[late] = _turned(readings[late], 3 * DEG)
    return gyro_b, accel_b


def _outliers(t, gyro_b, rng):
    hit = rng.random(len(t)) < 0.05
    gyro_b[hit] += 50 * _white(gyro_b[hit].shape, rng)
    return gyro_b


def _white(shape, rng):
    density = TABLE_SCENARIOS["turntable_navigation"].errors.gyro_noise_density
    return density * math.sqrt(TABLE_RATE) * rng.standard_normal(shape)


def _not_numbers(t, gyro_b, rng):
    gyro_b[rng.random(len(t)) < 0.01] = math.nan
    return gyro_b


def _rocking(t, gyro_b, accel_b, rng):
    """Somebody leans on the table for ten seconds, twice."""
    for start in (24.0, 130.0):
        lean = 2e-4 * np.clip((t - start) / 1.0, 0, 1) * np.clip((start + 10.0 - t) / 1.0, 0, 1)
        accel_b[:, 1] -= STANDARD_GRAVITY * lean
        gyro_b[:, 0] += np.gradient(lean, t)
    return gyro_b, accel_b


def _during(start, end, *rate):
    return _gyro(lambda t, gyro_b, rng: gyro_b + ((t >= start) & (t < end))[:, None] * np.array(rate))


def _poorer(name):
    """Return a fault: the sensors are of another grade than told."""
    def spoil(streams, rng):
        other = simulate_table(name, duration=TABLE_TIME, imu_rate=TABLE_RATE, seed=TABLE_SEED)
        return dataclasses.replace(streams, imu=other.imu)
    return spoil


TABLE_FAULTS = (
    Fault("none"),
    Fault("joint counts the wrong way", _joint(lambda t, angle: -angle)),
    Fault("joint in deg", _joint(lambda t, angle: np.degrees(angle))),
    Fault("joint of another axis: does not turn", _joint(lambda t, angle: 0 * angle)),
    Fault("gyros in deg/s", _gyro(lambda t, gyro_b, rng: np.degrees(gyro_b))),
    Fault("accelerometers in g", _imu(lambda t, gyro_b, accel_b, rng: (gyro_b, accel_b / STANDARD_GRAVITY))),
    Fault("IMU upside down", _imu(lambda t, gyro_b, accel_b, rng: (gyro_b * [1, -1, -1], accel_b * [1, -1, -1]))),
    Fault("joint 50 ms late", _late(0.05)),
    Fault("joint 0.5 s late", _late(0.5)),
    Fault("table moved by 3 deg half-way", _imu(_moved)),
    Fault("latitude 1 deg wrong", _told(latitude=LATITUDE + 1 * DEG)),
    Fault("latitude 5 deg wrong", _told(latitude=LATITUDE + 5 * DEG)),
    Fault("latitude with the other sign", _told(latitude=-LATITUDE)),
    Fault("latitude unknown", _told(latitude=math.nan)),
    Fault("encoder zero 0.1 deg off", _joint(lambda t, angle: angle + 0.1 * DEG)),
    Fault("encoder zero 0.1 deg off, told", lambda streams, rng: _told(table_zero_std=0.1 * DEG)(
        _joint(lambda t, angle: angle + 0.1 * DEG)(streams, rng), rng)),
    Fault("encoder off by 0.1 deg once a turn", _joint(lambda t, angle: angle + 0.1 * DEG * np.sin(angle))),
    Fault("gyro noise told 2 times too small", _gyro(
        lambda t, gyro_b, rng: gyro_b + math.sqrt(3) * _white(gyro_b.shape, rng))),
    Fault("gyro noise told 10 times too small", _gyro(
        lambda t, gyro_b, rng: gyro_b + math.sqrt(99) * _white(gyro_b.shape, rng))),
    Fault("tactical sensors told as navigation grade", _poorer("turntable_tactical")),
    Fault("noise told 10 times too large", _told(gyro_noise_density=5e-6, gyro_bias_instability=5e-7)),
    Fault("someone walks past: 5 % of the samples 50 sigma off", _gyro(_outliers)),
    Fault("someone leans on the table for 10 s, twice", _imu(_rocking)),
    Fault("one dwell disturbed, 1 deg/h", _during(56.0, 74.0, 0.0, DEG_PER_HOUR, 0.0)),
    Fault("base turns at 5 deg/h all the time", _gyro(lambda t, gyro_b, rng: gyro_b + [0, 0, 5 * DEG_PER_HOUR])),
    Fault("bias drifts by 1 deg/h in an hour", _gyro(
        lambda t, gyro_b, rng: gyro_b + np.outer(t, [DEG_PER_HOUR / 3600, 0, 0]))),
    Fault("gyro scale factor 0.5 % off", _gyro(lambda t, gyro_b, rng: gyro_b * [1.005, 1, 1])),
    Fault("gyros turned by 0.2 deg about the axis", _gyro(lambda t, gyro_b, rng: _turned(gyro_b, 0.2 * DEG))),
    Fault("x gyro stuck", _gyro(lambda t, gyro_b, rng: gyro_b * [0, 1, 1])),
    Fault("readings in steps of 0.2 deg/h and 1 mg", _imu(lambda t, gyro_b, accel_b, rng: (
        0.2 * DEG_PER_HOUR * np.rint(gyro_b / (0.2 * DEG_PER_HOUR)), 0.01 * np.rint(accel_b / 0.01)))),
    Fault("vibration: 1 mrad/s and 0.5 m/s^2 at 11 Hz", _imu(lambda t, gyro_b, accel_b, rng: (
        gyro_b + 1e-3 * np.sin(69.0 * t)[:, None], accel_b + 0.5 * np.cos(69.0 * t)[:, None]))),
    Fault("1 % of the samples not numbers", _gyro(_not_numbers)),
    Fault("10 % of samples and angles lost", _lost(0.1, 0.1)),
    Fault("3 s without samples", _lost(gap=(60.0, 63.0))),
    Fault("stops too short for the dwells", _told(dwell_time=60.0)),
    Fault("turns both ways", way="both ways"),
    Fault("turns one way", way="one way"),
    Fault("both ways, axis wobbles by 1 arcsec", way="both ways", stand={"wobble": ARCMINUTE / 60}),
    Fault("one way, axis wobbles by 1 arcsec", way="one way", stand={"wobble": ARCMINUTE / 60}),
    Fault("both ways, joint 20 ms late", _late(0.02), way="both ways"),
    Fault("one way, joint 20 ms late", _late(0.02), way="one way"),
    Fault("one way, joint 20 ms late, told", lambda streams, rng: _told(joint_delay_std=0.02)(
        _late(0.02)(streams, rng), rng), way="one way"),
)


def table_params(name="turntable_navigation"):
    """Return AlignmentParams that know a scenario's sensors."""
    scenario = TABLE_SCENARIOS[name]
    errors = scenario.errors
    return AlignmentParams(
        latitude=LATITUDE, gyro_noise_density=errors.gyro_noise_density,
        gyro_bias_instability=scenario.gyro_bias_instability, accel_noise_density=errors.accel_noise_density,
        accel_bias_std=errors.accel_bias_std, scale_std=errors.gyro_scale_std, skew_std=errors.gyro_misalignment_std,
        accel_scale_std=errors.accel_scale_std)


def table_streams(way, stand):
    """Return the streams of a sound table, but for ``stand``, a dict of its own imperfections."""
    params = table_params()
    if way == "dwells":
        recording = simulate_table("turntable_navigation", duration=TABLE_TIME, imu_rate=TABLE_RATE, seed=TABLE_SEED)
        return Streams(recording.imu, recording.joint, params)
    schedule = continuous_rotation(TURNING_RATE, TABLE_TIME, 1 / TABLE_RATE, way == "both ways")
    turntable = Turntable(ROLL, PITCH, HEADING, LATITUDE, gravity=float(normal_gravity(LATITUDE)), **stand)
    # 1/f noise of so many samples would take too long; white noise alone is most of it at this rate.
    gyro = TriadErrors(bias=(5e-8, -5e-8, 5e-8), noise_density=params.gyro_noise_density)
    accel = TriadErrors(bias=(5e-4, -5e-4, 5e-4), noise_density=params.accel_noise_density)
    readings = simulate_readings(turntable, schedule, gyro, accel, np.random.default_rng(TABLE_SEED))
    stamp_ns = np.rint(schedule.end * 1e9).astype(np.int64)
    imu = ImuSeries(stamp_ns, readings.gyro_b, readings.accel_b)
    middle_ns = stamp_ns - round(0.5e9 / TABLE_RATE)
    return Streams(imu, JointSeries(middle_ns, schedule.angle), params)


def find_on_table(streams):
    """Return the session after all of the streams."""
    session = TableSession(streams.params, follow=False)
    stamps = np.concatenate([streams.joint.stamp_ns, streams.imu.stamp_ns])
    count = len(streams.joint)
    for k in np.argsort(stamps, kind="stable").tolist():
        if k < count:
            session.add_joint(int(stamps[k]), float(streams.joint.angle[k]))
        else:
            session.add_imu(int(stamps[k]), streams.imu.gyro_b[k - count], streams.imu.accel_b[k - count])
    session.finish()
    return session


def table_row(index):
    """Return a row of the table's faults."""
    fault = TABLE_FAULTS[index]
    streams = fault.spoil(table_streams(fault.way, fault.stand), np.random.default_rng(TABLE_SEED))
    session = find_on_table(streams)
    warnings = [text for good, text in session.take_remarks() if not good]
    says = session.refusal or session.phase + "".join(f"; {text}" for text in warnings[:1]) \
        + (f" (and {len(warnings) - 1} more)" if len(warnings) > 1 else "")
    north = None if session.result is None else session.result.north
    if north is None or not np.isfinite(north.heading):
        return fault.name, says, "-", "-"
    error = float(wrap(float(north.heading) - HEADING))
    held_back = "withheld: " if session.refusal else ""
    return fault.name, says, f"{held_back}{error / DEG:.3f}", f"{abs(error) / float(north.std):.1f}"


def table_section(workers):
    """Return the turntable's faults."""
    rows = each(table_row, [(k,) for k in range(len(TABLE_FAULTS))], workers)
    return ["## Turntable", "",
            f"Navigation grade (0.01 deg/h, 0.003 deg/rt-h), {TABLE_TIME:.0f} s: two rounds of eight dwells, or "
            f"{TURNING_RATE / DEG:.0f} deg/s. A heading that is withheld is not published; its error is what it would "
            "have been. What nobody can see in these readings, the zero of the encoder and an IMU that is turned about "
            "the table's axis, is an error of the same size: `table_zero_std` says how large it may be.",
            *table(("fault", "what the finder says", "error, deg", "error / sigma"), rows)]


# --- standing vehicle ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Body:
    """Motion of a sprung body about where it stands.

    Attributes
    ----------
    t : (N,) s
    angle : (N, 3) rad, about x, y, z
    position : (N, 3) m, of its reference point, in body axes
    """

    t: np.ndarray
    angle: np.ndarray
    position: np.ndarray


def _oscillator(drive, frequency, damping, interval):
    """Return the response of a damped spring to where its foot is driven, sampled."""
    from scipy.signal import bilinear, lfilter

    omega = 2 * math.pi * frequency
    b, a = bilinear([omega ** 2], [1.0, 2 * damping * omega, omega ** 2], 1 / interval)
    return drive[0] + lfilter(b, a, drive - drive[0])


def _low_pass(t, time_constant, shape, rng):
    """Return noise of unit spread with a correlation time."""
    from scipy.signal import lfilter

    keep = math.exp(-(t[1] - t[0]) / time_constant)
    noise = lfilter([1 - keep], [1, -keep], rng.standard_normal((len(t), *shape)), axis=0)
    return noise / noise.std(axis=0)


def _wind(t, strength, rng):
    gust, fast = _low_pass(t, 3.0, (1,), rng), _low_pass(t, 0.3, (3,), rng)
    return strength * np.array([2e-4, 8e-5, 2e-5]) * (0.6 * gust + 0.5 * fast)


def _people(t, strength, rng):
    """Return the leaning of a body that people step into and out of, once in 40 s."""
    lean = np.zeros((len(t), 3))
    for start in rng.uniform(0, t[-1], rng.poisson(t[-1] / 40)):
        size = strength * np.array([2.5e-3, 1e-3, 2e-4]) * rng.standard_normal(3)
        lean += (1 - np.exp(-np.maximum(t - start, 0) / rng.uniform(0.2, 0.8)))[:, None] * size
    return lean


def _walking(t, strength, rng):
    """Return the rocking by people who walk for 2 to 10 s, once in 30 s."""
    rock = np.zeros((len(t), 3))
    for start in rng.uniform(0, t[-1], rng.poisson(t[-1] / 30)):
        end = start + rng.uniform(2, 10)
        on = np.clip(np.minimum(t - start, end - t) / 0.5, 0, 1)
        step = np.sin(2 * math.pi * rng.uniform(1.5, 2.2) * t + rng.uniform(0, 2 * math.pi))
        rock += (on * step)[:, None] * strength * np.array([4e-4, 2e-4, 5e-5]) * rng.standard_normal(3)
    return rock


def _settling(t, strength, rng):
    """Return the creep of springs and tyres after parking."""
    size = strength * np.array([3e-4, 3e-4, 1e-4]) * rng.standard_normal(3)
    return size * np.exp(-t / rng.uniform(20, 200))[:, None]


def _slams(t, strength, rng):
    """Return the shaking by doors that slam once a minute: angle and position."""
    angle, position = np.zeros((2, len(t), 3))
    for start in rng.uniform(0, t[-1], rng.poisson(t[-1] / 60)):
        after = np.maximum(t - start, 0)
        ring = np.sin(2 * math.pi * rng.uniform(8, 15) * after)
        angle += (np.exp(-after / 0.15) * ring)[:, None] * strength * 3e-4 * rng.standard_normal(3)
        position += (np.exp(-after / 0.1) * ring * after / 0.05)[:, None] * strength * 2e-4 * rng.standard_normal(3)
    return angle, position


def _engine(t, strength, rng):
    """Return the shaking by an engine that idles at about 27 Hz: angle and position."""
    angle, position = np.zeros((2, len(t), 3))
    wander = 0.3 * np.sin(2 * math.pi * t / 37 + rng.uniform(0, 2 * math.pi))
    phase = np.cumsum(2 * math.pi * (27 + wander)) * (t[1] - t[0])
    for harmonic, share in ((1, 1.0), (2, 0.4)):
        waves = np.sin(harmonic * phase[:, None] + rng.uniform(0, 2 * math.pi, 6))
        waves = strength * share * waves * rng.uniform(0.3, 1.0, 6)
        position += 1e-5 * waves[:, :3]
        angle += 1.5e-6 * waves[:, 3:]
    return angle, position


LEANS = {"wind": _wind, "people": _people, "walking": _walking, "settling": _settling}
SHAKES = {"slams": _slams, "engine": _engine}
EVERYTHING = (*LEANS, *SHAKES)


def sprung_body(t, kinds, strength, rng):
    """Return the :class:`Body` of a vehicle with these disturbances, of so many times their usual strength."""
    frequency = rng.uniform(0.9, 1.8) * np.array([1.0, 1.1, 1.6])
    damping = rng.uniform(0.1, 0.3)
    drive = sum((LEANS[kind](t, strength, rng) for kind in kinds if kind in LEANS), np.zeros((len(t), 3)))
    angle = np.stack([_oscillator(drive[:, j], frequency[j], damping, t[1] - t[0]) for j in range(3)], axis=-1)
    position = np.zeros((len(t), 3))
    for kind in kinds:
        if kind in SHAKES:
            more_angle, more_position = SHAKES[kind](t, strength, rng)
            angle, position = angle + more_angle, position + more_position
    return Body(t, angle, position)


def vehicle_readings(body, heading, tilt, lever, rate):
    """Return what perfect sensors in a body read, and the attitude at the end of each sample.

    Parameters
    ----------
    body : Body
        Sampled OVERSAMPLING times as often as the IMU.
    heading : float, rad
    tilt : (2,) rad
        Roll and pitch.
    lever : (3,) m
        From the point that the body rocks about to the IMU.
    rate : float, Hz
        Of the IMU.

    Returns
    -------
    imu : ImuSeries
    q_nb_wxyz : (N, 4)
    """
    interval = body.t[1] - body.t[0]
    stood = dcm_nb_from_euler(*tilt, heading)
    dcm_nb = stood @ dcm_nb_from_euler(*body.angle.T)
    path_n = (dcm_nb - stood) @ lever + body.position @ stood.T
    velocity_n = np.diff(path_n, axis=0) / interval
    at_samples = np.concatenate([velocity_n[:1], 0.5 * (velocity_n[1:] + velocity_n[:-1]), velocity_n[-1:]])
    acceleration_n = np.diff(at_samples, axis=0) / interval
    earth_n = earth_rate_n(LATITUDE)
    q_nb = quaternion_from_dcm(dcm_nb)
    turn_b = quaternion_log(quaternion_multiply(
        quaternion_conjugate(q_nb[:-1]), quaternion_multiply(quaternion_exp(earth_n * interval), q_nb[1:])))
    force_n = acceleration_n + 2 * np.cross(earth_n, velocity_n) - [0.0, 0.0, float(normal_gravity(LATITUDE))]
    # In the axes of the interval's beginning: the Earth turns on until half-way.
    force_n += 0.5 * interval * np.cross(earth_n, force_n)
    half_way = dcm_nb[:-1] @ dcm_from_quaternion(quaternion_exp(0.5 * turn_b))
    accel_b = np.einsum("kji,kj->ki", half_way, force_n)
    gyro_b, accel_b = (readings.reshape(-1, OVERSAMPLING, 3).mean(axis=1) for readings in (turn_b / interval, accel_b))
    stamp_ns = np.rint(np.arange(1, len(gyro_b) + 1) * 1e9 / rate).astype(np.int64)
    return ImuSeries(stamp_ns, gyro_b, accel_b), q_nb[OVERSAMPLING::OVERSAMPLING]


def standing_vehicle(kinds, strength, seed, duration=VEHICLE_TIME, rate=VEHICLE_RATE):
    """Return perfect readings in a vehicle with these disturbances, and its attitudes."""
    rng = np.random.default_rng([seed, 77])
    t = np.arange(round(duration * rate) * OVERSAMPLING + 1) / (rate * OVERSAMPLING)
    heading, tilt = rng.uniform(-math.pi, math.pi), rng.uniform(-3 * DEG, 3 * DEG, 2)
    lever = rng.uniform([-1.0, -0.5, -1.2], [1.0, 0.5, -0.3])
    return vehicle_readings(sprung_body(t, kinds, strength, rng), heading, tilt, lever, rate)


@dataclass(frozen=True)
class Disturbance:
    """What disturbs a vehicle, how strongly, what grade its sensors are, and what becomes of the samples."""

    name: str
    kinds: tuple
    strength: float = 1.0
    grade: str = "navigation"
    lost: Callable = lambda t, rng: np.zeros(len(t), dtype=bool)
    told_as: str = ""


VEHICLE_DISTURBANCES = (
    Disturbance("nothing", ()),
    Disturbance("wind", ("wind",)),
    Disturbance("people step in and out", ("people",)),
    Disturbance("people walk about", ("walking",)),
    Disturbance("doors slam", ("slams",)),
    Disturbance("engine idles", ("engine",)),
    Disturbance("springs settle", ("settling",)),
    Disturbance("all of these", EVERYTHING),
    Disturbance("all of these, three times as strong", EVERYTHING, strength=3.0),
    Disturbance("all, a tenth of the samples lost", EVERYTHING, lost=lambda t, rng: rng.random(len(t)) < 0.1),
    Disturbance("all, 0.5 s of samples lost every minute", EVERYTHING, lost=lambda t, rng: t % 60.0 > 59.5),
    Disturbance("all, 3 s of samples lost at 100 s", EVERYTHING, lost=lambda t, rng: (t > 100.0) & (t < 103.0)),
    Disturbance("all, tactical sensors", EVERYTHING, grade="tactical"),
    Disturbance("all, tactical sensors told as navigation grade", EVERYTHING, grade="tactical",
                told_as="navigation"),
)


def vehicle_run(index, seed):
    """Return (error, sigma) at each mark, NaN where no heading may be believed, the phases and the last refusal."""
    case = VEHICLE_DISTURBANCES[index]
    perfect, q_nb = standing_vehicle(case.kinds, case.strength, seed)
    rng = np.random.default_rng([seed, 5])
    imu = apply_imu_errors(perfect, PARKED_GRADES[case.grade].errors, rng).imu
    kept = ~case.lost((imu.stamp_ns - imu.stamp_ns[0]) * 1e-9, rng)
    imu = ImuSeries(imu.stamp_ns[kept], imu.gyro_b[kept], imu.accel_b[kept])
    aligner = StandingAligner(told(PARKED_GRADES[case.told_as or case.grade].errors))
    found, phases, before = np.full((len(MARKS), 2), np.nan), [], imu.stamp_ns[0] - 1
    for row, mark in zip(found, MARKS, strict=True):
        part = (imu.stamp_ns > before) & (imu.stamp_ns <= round(1e9 * mark))
        phases += [phase for phase, _ in aligner.run(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part],
                                                               imu.accel_b[part]))]
        before = imu.stamp_ns[part][-1]
        if not aligner.refusal and aligner.phase in ("fine", "aligned"):
            result = aligner.result
            truth = q_nb[np.searchsorted(perfect.stamp_ns, result.stamp_ns)]
            apart = quaternion_log(quaternion_multiply(result.q_nb_wxyz, quaternion_conjugate(truth)))
            row[:] = apart[2], result.heading_std
    return found, phases, aligner.refusal


def _path(phases):
    """Return phases without repetition."""
    return " ".join(phase for k, phase in enumerate(phases) if k == 0 or phase != phases[k - 1])


def vehicle_section(seeds, workers):
    """Return the vehicle's disturbances."""
    jobs = [(k, seed) for k in range(len(VEHICLE_DISTURBANCES)) for seed in range(seeds)]
    runs = dict(zip(jobs, each(vehicle_run, jobs, workers), strict=True))
    rows = []
    for k, case in enumerate(VEHICLE_DISTURBANCES):
        mine = [runs[k, seed] for seed in range(seeds)]
        paths = [_path(phases) for _, phases, _ in mine]
        usual = max(sorted(set(paths)), key=paths.count)
        others = f" ({paths.count(usual)} of {seeds})" if paths.count(usual) < seeds else ""
        for j, mark in enumerate(MARKS):
            pairs = np.array([found[j] for found, _, _ in mine])
            pairs = pairs[np.isfinite(pairs[:, 0])]
            last = j == len(MARKS) - 1
            figures = ("-", "-", "-", "-")
            if len(pairs):
                z = pairs[:, 0] / pairs[:, 1]
                figures = (f"{root_mean(pairs[:, 0]) / ARCMINUTE:.1f}", f"{np.median(pairs[:, 1]) / ARCMINUTE:.1f}",
                           f"{np.mean(z ** 2):.2f}", f"{np.abs(z).max():.1f}")
            elif last:
                usual, others = mine[0][2], ""
            rows.append((case.name if j == 0 else "", f"{mark:.0f}", f"{len(pairs)} of {seeds}", *figures,
                         usual + others if last else ""))
    return ["## Standing vehicle", "",
            f"A sprung body (0.9 to 1.8 Hz) with the IMU up to a metre from where it rocks, {VEHICLE_RATE:.0f} Hz, "
            f"headings all round the circle, all errors of navigation-grade sensors (0.01 deg/h); {seeds} vehicles "
            "each. People step in once in 40 s (2.5 mrad of roll) and walk once in 30 s, a door slams once a minute, "
            "an engine idles at 27 Hz. Arcminutes; phases one after another, of most of the vehicles, or why there is "
            "no heading.",
            *table(("disturbance", "seconds", "with a heading", "heading error, RMS", "median sigma", "mean z^2",
                    "largest z", "phases"), rows)]


if __name__ == "__main__":
    main()

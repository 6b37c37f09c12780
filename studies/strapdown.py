"""The strapdown navigator against closed forms and exact motions over the turning Earth.

``study_strapdown`` writes docs/results/strapdown.md and its plots; every figure in it is computed here, noise-free.
"The paper" is the source of :mod:`inertial.strapdown`, whose figures 2.3 and 2.4 are the algorithm.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from inertial.earth import (
    SEMI_MAJOR_AXIS,
    STANDARD_GRAVITY,
    earth_rate_n,
    normal_gravity,
    radii_of_curvature,
    transport_rate_n,
)
from inertial.imu_errors import Calibration
from inertial.rotation import (
    dcm_nb_from_euler,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
)
from inertial.strapdown import (
    SCHEMES,
    NavigationState,
    Strapdown,
    StrapdownParams,
    VerticalChannelError,
    combine_increments,
    dcm_en,
)
from inertial.trajectory import Motion
from studies import head_commit
from studies.north_finding import table
from studies.timing import times_in_turn

DEG = np.pi / 180
MICRO_G = 1e-6 * STANDARD_GRAVITY
LATITUDE = 45 * DEG
HOUR = 3600.0

CONING_ANGLE = 0.1 * DEG
ORDER_ANGLE = 0.02 * DEG
CONING_MAJOR = 0.01  # s
CONING_TIME = 20.0  # s
SCULLING_FORCE = 10.0  # m/s^2: with 0.1 deg in phase the true mean force is 890 ug
SCULLING_TIME = 20.0  # s
CONING_LIMITS = {"2": 0.25, "2+previous": 0.02, "3": 2e-3, "4": 1e-5}  # deg/h
ORDERS, ORDER_TOLERANCE = {"2": 5, "2+previous": 7, "3": 7, "4": 9}, 0.2
SCULLING_LIMITS = {"2": 5.0, "2+previous": 0.5, "3": 0.05, "4": 1e-3}  # ug

STATIC_LIMIT = 1e-3  # m
SCHULER_AMPLITUDE, SCHULER_AMPLITUDE_PART = 636.4, 0.01  # m
SCHULER_PERIOD, SCHULER_PERIOD_PART = 84.4 * 60, 0.005  # s
MANOEUVRE_LIMIT = 5e-3  # m
VIBRATION_LIMIT = 0.2  # m
VIBRATION = 12.0  # Hz
STEP_LIMIT = 2.0  # us

# Four Gauss-Legendre nodes integrate a 12 Hz vibration over 2.5 ms to rounding.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_BLOCK = 20_000


# --- exact motions over the ellipsoid -----------------------------------------------------------------


@dataclass(frozen=True)
class Waves:
    """A quantity of time: ``start + slope t`` plus sine waves given as (amplitude, rad/s, phase)."""

    start: float = 0.0
    slope: float = 0.0
    waves: tuple = ()

    def __call__(self, t, derivative=0):
        """Return the value or a derivative at times (...)."""
        straight = (self.start + self.slope * t, np.full_like(t, self.slope), np.zeros_like(t))[derivative]
        return straight + sum(amplitude * rate**derivative * np.sin(rate * t + phase + derivative * np.pi / 2)
                              for amplitude, rate, phase in self.waves)

    def plus(self, *waves):
        """Return the same with more waves."""
        return replace(self, waves=self.waves + waves)


@dataclass(frozen=True)
class EarthMotion:
    """A motion over the ellipsoid: geodetic position and Euler angles as functions of time."""

    latitude: Waves
    longitude: Waves
    height: Waves
    roll: Waves = Waves()
    pitch: Waves = Waves()
    heading: Waves = Waves()

    def state(self, t):
        """Return the exact :class:`inertial.strapdown.NavigationState` at times (...)."""
        latitude, longitude, height = (quantity(t) for quantity in (self.latitude, self.longitude, self.height))
        q_nb_wxyz = quaternion_from_dcm(dcm_nb_from_euler(self.roll(t), self.pitch(t), self.heading(t)))
        return NavigationState(latitude, longitude, height, self._velocity_n(t)[0], q_nb_wxyz)

    def sensed(self, t):
        """Return what perfect sensors read, ``(gyro_b, accel_b)``, (..., 3)."""
        latitude, height = self.latitude(t), self.height(t)
        velocity_n, acceleration_n = self._velocity_n(t)
        motion = Motion(*(angle(t, k) for k in range(2) for angle in (self.roll, self.pitch, self.heading)),
                        velocity_n, acceleration_n)
        earth_n = earth_rate_n(latitude)
        frame_n = earth_n + transport_rate_n(latitude, height, velocity_n)
        force_n = acceleration_n + np.cross(earth_n + frame_n, velocity_n)
        force_n[..., 2] -= normal_gravity(latitude, height)
        dcm_nb = motion.dcm_nb
        return (motion.rate_b + np.einsum("...ji,...j->...i", dcm_nb, frame_n),
                np.einsum("...ji,...j->...i", dcm_nb, force_n))

    def samples(self, duration, interval):
        """Return means over sample intervals, (N, 3) each: rad/s and m/s^2."""
        count = round(duration / interval)
        blocks = []
        for first in range(0, count, _BLOCK):
            starts = interval * np.arange(first, min(first + _BLOCK, count))
            at = starts[:, None] + 0.5 * interval * (1 + _NODES)
            blocks.append([np.einsum("k,nki->ni", 0.5 * _WEIGHTS, values) for values in self.sensed(at)])
        return [np.concatenate(column) for column in zip(*blocks, strict=True)]

    def _velocity_n(self, t):
        """Return velocity_n and its derivative, (..., 3)."""
        latitude, height = self.latitude(t), self.height(t)
        rate, longitude_rate, climb = (quantity(t, 1) for quantity in (self.latitude, self.longitude, self.height))
        meridian, transverse = radii_of_curvature(latitude)
        sine, cosine = np.sin(latitude), np.cos(latitude)
        # d(transverse)/d(latitude) is this times transverse; three times as much for the meridian.
        growth = (1 - meridian / transverse) * np.tan(latitude) * rate
        north_radius, parallel = meridian + height, (transverse + height) * cosine
        velocity_n = np.stack([north_radius * rate, parallel * longitude_rate, -climb], axis=-1)
        parallel_rate = (transverse * growth + climb) * cosine - (transverse + height) * sine * rate
        acceleration_n = np.stack([
            north_radius * self.latitude(t, 2) + (3 * meridian * growth + climb) * rate,
            parallel * self.longitude(t, 2) + parallel_rate * longitude_rate, -self.height(t, 2)], axis=-1)
        return velocity_n, acceleration_n


def period(seconds):
    """Return the angular frequency, rad/s."""
    return 2 * np.pi / seconds


AT_REST = EarthMotion(Waves(LATITUDE), Waves(0.5), Waves(100.0), Waves(6 * DEG), Waves(-4 * DEG), Waves(30 * DEG))
LEVEL_AT_REST = EarthMotion(Waves(LATITUDE), Waves(0.5), Waves(100.0))
MANOEUVRE = EarthMotion(
    Waves(LATITUDE, 0.0, ((4000 / 6.38e6, period(240), 0.0),)),
    Waves(0.5, 0.0, ((6000 / 4.5e6, period(400), 1.0),)),
    Waves(1000.0, 0.0, ((200.0, period(180), 0.5),)),
    Waves(0.0, 0.0, ((30 * DEG, period(25), 0.0),)),
    Waves(2 * DEG, 0.0, ((10 * DEG, period(17), 0.3),)),
    Waves(1.0, 2 * DEG, ((20 * DEG, period(31), 0.0),)))


def vibrating(motion):
    """Return the motion with 12 Hz of 0.1 deg coning and 5 m/s^2 in phase with the roll."""
    rate = 2 * np.pi * VIBRATION
    shake = 5.0 / rate**2
    return replace(
        motion, roll=motion.roll.plus((CONING_ANGLE, rate, 0.0)),
        pitch=motion.pitch.plus((CONING_ANGLE, rate, np.pi / 2)),
        latitude=motion.latitude.plus((shake / 6.38e6, rate, 0.0)),
        height=motion.height.plus((shake, rate, 0.0)))


def navigate(motion, duration, scheme, sample_interval, *, aided=True, accel_error=(0.0, 0.0, 0.0), every=None,
             **settings):
    """Run the navigator from the exact start of a motion through its exact samples.

    Returns
    -------
    time : (M,), s
    state, truth : NavigationState
    """
    params = StrapdownParams(scheme=scheme, sample_interval=sample_interval, **settings)
    gyro_b, accel_b = motion.samples(duration, sample_interval)
    steps = len(gyro_b) // SCHEMES[scheme].samples
    time = params.major_interval * np.arange(1, steps + 1)
    every = every or max(1, round(1.0 / params.major_interval))
    navigator = Strapdown(params, motion.state(np.zeros(())))
    state = navigator.run(gyro_b, accel_b + accel_error, motion.height(time) if aided else None, every)
    return time[every - 1::every], state, motion.state(time[every - 1::every])


def position_error_n(state, truth):
    """Return the position error north, east, down, (..., 3), m."""
    meridian, transverse = radii_of_curvature(truth.latitude)
    return np.stack([(state.latitude - truth.latitude) * (meridian + truth.height),
                     (state.longitude - truth.longitude) * (transverse + truth.height) * np.cos(truth.latitude),
                     truth.height - state.height], axis=-1)


def attitude_error_n(state, truth):
    """Return the small rotation that takes the true attitude to the navigator's, (..., 3), rad, NED."""
    return quaternion_log(quaternion_multiply(state.q_nb_wxyz, quaternion_conjugate(truth.q_nb_wxyz)))


# --- coning and sculling ------------------------------------------------------------------------------


def coning_drift(scheme, frequency, angle=CONING_ANGLE, duration=CONING_TIME):
    """Return the attitude drift about the cone's axis, deg/h, of increments exact in closed form."""
    rate, (dtheta_b, t) = 2 * np.pi * frequency, _coning_increments(scheme, frequency, angle, duration)
    phi, _ = combine_increments(dtheta_b[1:], np.zeros_like(dtheta_b[1:]), scheme, [*dtheta_b[0], 0, 0, 0])
    start, end = (_on_cone(angle, rate * at) for at in (0.0, t[-1]))
    error = quaternion_log(quaternion_multiply(_product(start, phi), quaternion_conjugate(end)))
    return abs(error[2]) / duration * HOUR / DEG


def _coning_increments(scheme, frequency, angle, duration):
    """Return increments, the first of them before time zero, and the times of their ends."""
    rate = 2 * np.pi * frequency
    interval = CONING_MAJOR / SCHEMES[scheme].samples
    t = interval * np.arange(-1, round(duration / interval) + 1)
    integral = np.stack([np.sin(angle) * np.cos(rate * t), np.sin(angle) * np.sin(rate * t),
                         -2 * rate * np.sin(angle / 2)**2 * t], axis=-1)
    return np.diff(integral, axis=0), t[1:]


def _on_cone(angle, phase):
    return np.array([np.cos(angle / 2), np.sin(angle / 2) * np.cos(phase), np.sin(angle / 2) * np.sin(phase), 0.0])


def _product(q, rotation_vectors):
    for step in quaternion_exp(rotation_vectors):
        q = quaternion_multiply(q, step)
    return q


def coning_order(scheme):
    """Return the order of the coning drift in frequency, from 10 to 20 Hz, where the angle's square rules."""
    low, high = (coning_drift(scheme, frequency, ORDER_ANGLE) for frequency in (10.0, 20.0))
    return np.log2(high / low)


def sculling(scheme, frequency=20.0):
    """Return the error of the mean force and the true mean force, ug.

    Roll ``a sin(W t)`` with the force ``F sin(W t)`` along the body's y axis: the mean force down is
    ``F J1(a)``, in which the terms beyond ``a/2 - a^3/16`` vanish.
    """
    rate, interval = 2 * np.pi * frequency, CONING_MAJOR / SCHEMES[scheme].samples
    t = interval * np.arange(-1, round(SCULLING_TIME / interval) + 1)
    dtheta_b, dvel_b = (np.zeros((len(t) - 1, 3)) for _ in range(2))
    dtheta_b[:, 0] = CONING_ANGLE * np.diff(np.sin(rate * t))
    dvel_b[:, 1] = -SCULLING_FORCE / rate * np.diff(np.cos(rate * t))
    phi, gained_b = combine_increments(dtheta_b[1:], dvel_b[1:], scheme, [*dtheta_b[0], *dvel_b[0]])
    roll = np.concatenate([[0.0], np.cumsum(phi[:-1, 0])])
    mean = np.sum(np.sin(roll) * gained_b[:, 1] + np.cos(roll) * gained_b[:, 2]) / SCULLING_TIME
    true = SCULLING_FORCE * (CONING_ANGLE / 2 - CONING_ANGLE**3 / 16)
    return abs(mean - true) / MICRO_G, true / MICRO_G


def uncorrected():
    """Return coning drift, deg/h, and sculling error, ug, of plain sums at 20 Hz, in closed form."""
    phase = 2 * np.pi * 20.0 * CONING_MAJOR
    lost = 1 - np.sin(phase) / phase
    drift = CONING_ANGLE**2 / 2 * 2 * np.pi * 20.0 * lost
    return drift * HOUR / DEG, lost * SCULLING_FORCE * CONING_ANGLE / 2 / MICRO_G


def coning_section(plots):
    """Return the tables of coning and sculling, and draw the drift against frequency."""
    rows = []
    for scheme in SCHEMES:
        drift, order, (force, true) = coning_drift(scheme, 20.0), coning_order(scheme), sculling(scheme)
        limit, expected = CONING_LIMITS.get(scheme, np.inf), ORDERS.get(scheme, order)
        sculling_limit = SCULLING_LIMITS.get(scheme, np.inf)
        good = drift <= limit and abs(order - expected) <= ORDER_TOLERANCE and force <= sculling_limit
        rows.append((scheme, f"{drift:.2g}", _limit(limit), f"{order:.2f}",
                     f"{ORDERS[scheme]} +- {ORDER_TOLERANCE}" if scheme in ORDERS else "", f"{force:.2g}",
                     _limit(sculling_limit), _word(good) if scheme in CONING_LIMITS else ""))
    draw_coning(plots / "coning.png")
    plain_drift, plain_force = uncorrected()
    return ["## Coning and sculling", "",
            f"Half-angle 0.1 deg at 20 Hz, major interval {CONING_MAJOR * 1e3:.0f} ms, increments exact in closed "
            f"form. Left uncorrected the drift is {plain_drift:.1f} deg/h and the force is wrong by {plain_force:.0f} "
            f"of {true:.0f} ug. The order in frequency is from 10 to 20 Hz at {ORDER_ANGLE / DEG:.2f} deg: at 0.1 deg "
            "a term of fourth order in the angle, 1e-8 deg/h at 10 Hz, which no scheme of products of two "
            "increments sees, is as large as what four samples leave.",
            *table(("scheme", "drift, deg/h", "limit", "order", "expected", "sculling error, ug", "limit", "verdict"),
                   rows), "", "![coning drift](strapdown/coning.png)"]


def _limit(value):
    return f"{value:g}" if np.isfinite(value) else ""


def _word(good):
    return "held" if good else "**missed**"


def draw_coning(path):
    """Draw the drift of each scheme against frequency."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    frequencies = np.geomspace(4, 40, 12)
    for scheme in SCHEMES:
        axes.loglog(frequencies, [coning_drift(scheme, f, duration=2.0) for f in frequencies], label=scheme)
    axes.set_xticks([4, 10, 20, 40], ["4", "10", "20", "40"])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("frequency, Hz (major interval 10 ms)")
    axes.set_ylabel("drift at 0.1 deg half-angle, deg/h")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(title="samples")
    figure.savefig(path, dpi=100, metadata={"Software": None})


# --- runs over the Earth ------------------------------------------------------------------------------


def runs_section(plots, hours):
    """Return static, Schuler, manoeuvre and vibration runs beside their limits; draw the Schuler swing."""
    rest = largest_error(*navigate(AT_REST, 3 * HOUR * hours, "2", 0.005))
    amplitude, swing = schuler(plots / "schuler.png")
    manoeuvre = largest_error(*navigate(MANOEUVRE, HOUR * hours, "2", 0.005))
    rows = [
        _row(f"at rest {3 * hours:g} h, perfect sensors", 1e3 * rest, 1e3 * STATIC_LIMIT, "mm"),
        ("100 ug: Schuler amplitude, m", f"{amplitude:.1f}", f"{SCHULER_AMPLITUDE} +- 1 %",
         _word(abs(amplitude / SCHULER_AMPLITUDE - 1) <= SCHULER_AMPLITUDE_PART)),
        ("100 ug: Schuler period, min", f"{swing / 60:.2f}", "84.4 +- 0.5 %",
         _word(abs(swing / SCHULER_PERIOD - 1) <= SCHULER_PERIOD_PART)),
        _row(f"{hours:g} h manoeuvre, 2 samples, 200/100 Hz", 1e3 * manoeuvre, 1e3 * MANOEUVRE_LIMIT, "mm")]
    shaken = {scheme: largest_error(*navigate(vibrating(MANOEUVRE), HOUR * hours, scheme, 0.0025))
              for scheme in ("1+previous", "2", "2+previous", "4")}
    rows.append(_row("the same with 12 Hz vibration, 2+previous, 400/200 Hz", shaken["2+previous"], VIBRATION_LIMIT,
                     "m"))
    return ["## Over the turning Earth", "",
            "Largest position error at any time, three axes together. Truth and samples are exact: latitude, "
            "longitude, height and Euler angles are sums of sines, rate and force their analytic derivatives on the "
            "ellipsoid, samples their integrals. The manoeuvre: figures of eight at up to 140 m/s, "
            "roll +-30 deg, pitch +-10 deg, turning on and on; the vibration: coning of 0.1 deg and 5 m/s^2 in "
            "phase with the roll. The vertical channel is aided by the true altitude.",
            *table(("run", "here", "limit", "verdict"), rows), "",
            "The vibration by scheme, samples at 400 Hz, m: "
            + ", ".join(f"{scheme} {error:.2g}" for scheme, error in shaken.items())
            + ". What is left at rest is rounding.", "",
            "![Schuler](strapdown/schuler.png)"]


def _row(what, value, limit, unit):
    return f"{what}, {unit}", f"{value:.2g}", f"{limit:g}", _word(value <= limit)


def largest_error(time, state, truth):
    """Return the largest distance from the truth, m."""
    del time
    return float(np.linalg.norm(position_error_n(state, truth), axis=-1).max())


def schuler(path=None):
    """Return amplitude, m, and period, s, of the swing that 100 ug to the north make from rest."""
    time, state, truth = navigate(LEVEL_AT_REST, 3 * HOUR, "2", 0.005, accel_error=(100 * MICRO_G, 0.0, 0.0))
    error_n = position_error_n(state, truth)
    first = np.argmax(error_n[:5000, 0])
    back = first + np.argmin(error_n[first:2 * first + 1000, 0])
    if path is not None:
        draw_schuler(path, time, error_n)
    return float(error_n[first, 0]) / 2, float(time[back])


def draw_schuler(path, time, error_n):
    """Draw position errors against time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(time / 60, error_n[:, 0], label="north")
    axes.plot(time / 60, error_n[:, 1], label="east")
    axes.set_xlabel("time, min")
    axes.set_ylabel("position error of 100 ug to the north, m")
    axes.grid(True, alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=100, metadata={"Software": None})


# --- what the user chooses ----------------------------------------------------------------------------


def semantics_section():
    """Return what it costs to take point samples for means, and the vertical channel with and without aiding."""
    rows = []
    for kind, told in (("mean", "mean"), ("point", "point"), ("point", "mean")):
        rows.append((kind, told, f"{semantics_error(kind, told):.2g}"))
    return ["## What a sample is", "",
            "The manoeuvre for 60 s, 2 samples, 200/100 Hz. Point samples have lost what happens between them; the "
            "parabola through three of them gives most of it back. Taken for means they are half a sample "
            "late.",
            *table(("samples are", "`imu_semantics`", "position error, m"), rows)]


def semantics_error(kind, told, duration=60.0, interval=0.005):
    """Return the position error of the manoeuvre after 60 s, m."""
    ends = interval * np.arange(1, round(duration / interval) + 1)
    gyro_b, accel_b = MANOEUVRE.samples(duration, interval) if kind == "mean" else MANOEUVRE.sensed(ends)
    navigator = Strapdown(StrapdownParams(scheme="2", sample_interval=interval, imu_semantics=told),
                          MANOEUVRE.state(np.zeros(())))
    state = navigator.run(gyro_b, accel_b, MANOEUVRE.height(ends[1::2]), every=len(ends) // 2)
    return largest_error(None, state, MANOEUVRE.state(ends[-1:]))


def vertical_section(plots):
    """Return how a height error grows without aiding, beside its closed form and the aided channel."""
    error = (0.0, 0.0, 100 * MICRO_G)
    time, free, truth = navigate(LEVEL_AT_REST, HOUR, "2", 0.005, aided=False, accel_error=error,
                                 unaided_limit=np.nan)
    _, aided, _ = navigate(LEVEL_AT_REST, HOUR, "2", 0.005, accel_error=error)
    heights = [truth.height - state.height for state in (free, aided)]
    growth = np.sqrt(2 * STANDARD_GRAVITY / SEMI_MAJOR_AXIS)
    rows = []
    for minutes in (5, 10, 20, 30, 60):
        at = 60 * minutes - 1
        expected = 100 * MICRO_G * (np.cosh(growth * time[at]) - 1) / growth**2
        rows.append((minutes, f"{heights[0][at]:.4g}", f"{expected:.4g}", f"{heights[1][at]:.2g}"))
    draw_vertical(plots / "vertical.png", time, heights)
    return ["## The vertical channel needs aiding", "",
            "Gravity falls with height, so a height error feeds itself: an accelerometer bias b makes b (cosh kt - "
            "1)/k^2, k^2 = 2g/R, tenfold every 22 minutes in the end. With an altitude a third-order loop "
            f"holds it. {refusal()}",
            *table(("minutes", "error of 100 ug alone, m", "closed form, m", "with altitude, m"), rows), "",
            "![vertical channel](strapdown/vertical.png)"]


def refusal():
    """Return what a run without an altitude says."""
    try:
        navigate(LEVEL_AT_REST, 700.0, "2", 0.01, aided=False)
    except VerticalChannelError as refused:
        return f"Beyond ten minutes without one the navigator refuses: \"{refused}\"."
    return "**Not refused.**"


def draw_vertical(path, time, heights):
    """Draw height errors without and with aiding."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    for height, label in zip(heights, ("alone", "with altitude"), strict=True):
        axes.semilogy(time / 60, np.abs(height), label=label)
    axes.set_xlabel("time, min")
    axes.set_ylabel("height error of 100 ug, m")
    axes.set_ylim(1e-3, 1e5)
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=100, metadata={"Software": None})


# --- the paper, cost ----------------------------------------------------------------------------------


def claims_section():
    """Return a verdict on each thing that the paper's block diagrams say, with the figure that decides."""
    raw, compensated = compensation_errors()
    one, two = (largest_error(*navigate(vibrating(MANOEUVRE), 600.0, scheme, interval))
                for scheme, interval in (("1+previous", 0.005), ("2+previous", 0.0025)))
    _, state, truth = navigate(MANOEUVRE, 600.0, "2", 0.005)
    turned = np.abs(attitude_error_n(state, truth)).max()
    rows = [
        ("deterministic errors (bias, scale factor, misalignment) are taken out first (figure 2.3)",
         f"confirmed: of 0.02 deg/s, 2 mg, 0.2 % and 2 mrad {raw:.0f} m after 60 s without, {compensated:.1e} m with"),
        ("coning and sculling are corrected over hN3 from increments over hN1 (figure 2.3)",
         "confirmed (table above); the paper gives no factors, those here are the optimal ones"),
        ("two rates: a fast hN1, a slower hN3",
         f"confirmed: vibration for 10 min, updates at 200 Hz: {one:.2g} m from samples at 200 Hz, {two:.2g} m from "
         "400 Hz"),
        ("quaternion by the body's rotation, then by the navigation frame's, then normalised (figures 2.3, 2.4)",
         f"confirmed: attitude within {turned:.0e} rad through ten minutes of the manoeuvre"),
        ("velocities in x and y only (figure 2.4)",
         "right, if height comes from elsewhere: the vertical channel alone diverges (table above)"),
        ("\"Vx, Vy are in Earth-centred axes\" (list of symbols)",
         "(!) not those that b_ij is turned by: they are along the horizontal navigation axes, wander azimuth from "
         "north; V_N and V_E follow by that angle"),
        ("position, heading and wander come from b_ij, b from navigation to Earth axes",
         f"confirmed, and no latitude is special: {pole_error():.1e} m after ten minutes across the north pole")]
    return ["## The paper's algorithm", *table(("what figures 2.3 and 2.4 say", "verdict"), rows)]


def compensation_errors():
    """Return the position error after 60 s with constant sensor errors, left in and taken out, m."""
    rng = np.random.default_rng(0)
    gyro, accel = (Calibration(2e-3 * rng.standard_normal((3, 3)), bias * rng.standard_normal(3))
                   for bias in (0.02 * DEG, 2000 * MICRO_G))
    gyro_b, accel_b = MANOEUVRE.samples(60.0, 0.005)
    readings = [truth_b @ (np.eye(3) + calibration.matrix).T + calibration.bias_b
                for truth_b, calibration in ((gyro_b, gyro), (accel_b, accel))]
    errors = []
    for calibrations in ((), (gyro, accel)):
        navigator = Strapdown(StrapdownParams(scheme="2"), MANOEUVRE.state(np.zeros(())), *calibrations)
        state = navigator.run(*readings, MANOEUVRE.height(0.01 * np.arange(1, 6001)), every=6000)
        errors.append(largest_error(None, state, MANOEUVRE.state(np.array([60.0]))))
    return errors


def pole_error(speed=200.0, duration=600.0):
    """Return the horizontal error after a flight along a meridian and across the north pole, m."""
    polar_radius = 6.4e6
    motion = EarthMotion(Waves(np.pi / 2 - speed * 0.5001 * duration / polar_radius, speed / polar_radius),
                         Waves(0.5), Waves(1000.0), Waves(0.0, 0.0, ((0.1, period(20), 0.0),)))
    _, state, truth = navigate(motion, duration, "2", 0.005)
    apart = dcm_en(state.latitude, state.longitude)[..., 2] - dcm_en(truth.latitude, truth.longitude)[..., 2]
    return polar_radius * float(np.linalg.norm(apart, axis=-1).max())


def step_cost(steps=2000, rounds=50):
    """Return what a compiled major step takes, samples and error compensation included, scheme to us."""
    runs = {}
    for scheme in SCHEMES:
        params = StrapdownParams(scheme=scheme, sample_interval=0.0025)
        samples = AT_REST.samples(steps * params.major_interval, params.sample_interval)
        altitude = np.full(steps, 100.0)
        navigator = Strapdown(params, AT_REST.state(np.zeros(())))
        runs[scheme] = lambda navigator=navigator, samples=samples, altitude=altitude: navigator.run(
            *samples, altitude, every=steps)
    return times_in_turn(runs, steps, rounds=rounds)


def cost_section():
    """Return what a major step costs here."""
    rows = [(scheme, f"{cost:.2f}", f"{STEP_LIMIT:g}", _word(cost <= STEP_LIMIT))
            for scheme, cost in step_cost().items()]
    return ["## Cost", "", "A major step in a compiled run, its samples' compensation included, on the machine that "
            "made this page (least of fifty rounds).", *table(("scheme", "us", "limit, us", "verdict"), rows)]


def main(argv=None):
    """Write the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of the results")
    parser.add_argument("--hours", type=float, default=1.0, help="length of a manoeuvre; rest takes three times it")
    arguments = parser.parse_args(argv)
    plots = arguments.out / "strapdown"
    plots.mkdir(parents=True, exist_ok=True)
    sections = [
        ["# Strapdown navigation", "",
         f"Made by `study_strapdown` from commit {head_commit()}; no noise, hence no seed "
         "but 0 for one set of sensor errors. The algorithm is told in `inertial/strapdown.py`."],
        coning_section(plots), runs_section(plots, arguments.hours), semantics_section(), vertical_section(plots),
        claims_section(), cost_section()]
    text = "\n\n".join("\n".join(section) for section in sections) + "\n"
    (arguments.out / "strapdown.md").write_text(text, encoding="utf-8")
    print(arguments.out / "strapdown.md")


if __name__ == "__main__":
    main()

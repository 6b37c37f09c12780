"""A small helicopter: its hover model, a controller that linearises it, a Kalman-Bucy filter, and a flight.

The model is the Yamaha R-50 in hover as identified by Mettler, Kanade and Tischler (CMU-RI-TR-00-03): rigid body,
first-order rotor flapping ``a`` (longitudinal) and ``b`` (lateral), stabiliser bar ``c`` and ``d``, and the yaw
gyro's filter ``rfb``; here with heading and height it has 15 states. Inputs are stick deflections from -1 to 1, zero
in trim. The report counts in feet; everything told by this module is in SI.

Controller and filter are of a paper in Persian on estimating a helicopter's state with two Kalman filters, "the paper"
below. The controller is input-output linearisation: roll and pitch are differentiated three times, heading and
height twice, until the inputs appear, which are then solved for. What remains inside, the zero dynamics, must be
stable and is (:func:`zero_dynamics`). The filter is equations 23 to 31.

**All of it is linear, about hover.** Beyond about 10 deg of roll or pitch the filter is told wrong things by its
model; :func:`fly` warns.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from inertial.earth import STANDARD_GRAVITY
from inertial.trajectory import Motion

STATES = ("u", "v", "p", "q", "phi", "theta", "a", "b", "w", "r", "rfb", "c", "d", "psi", "h")
INPUTS = ("lat", "lon", "ped", "col")
OUTPUTS = ("phi", "theta", "psi", "h")
LINEAR_RANGE = np.radians(10.0)
"""Roll and pitch within which the linear model may be believed."""

_FOOT = 0.3048
_IDENTIFIED_STATES = 13
# ft, rad, s. Nv and Nw are second-hand: taken from a reprint of the report's table, not from the report.
_ROTOR_TIME, _BAR_TIME = 0.04631, 0.3415
_STATE_DERIVATIVES = {
    "u": {"u": -0.05046, "theta": -32.2, "a": -32.2},
    "v": {"v": -0.1539, "phi": 32.2, "b": 32.2},
    "p": {"u": -0.1437, "v": 0.1432, "b": 166.1},
    "q": {"u": -0.05611, "v": -0.0585, "a": 82.57},
    "phi": {"p": 1.0},
    "theta": {"q": 1.0},
    "a": {"q": -1.0, "a": -1 / _ROTOR_TIME, "b": -0.1892 / _ROTOR_TIME, "c": 0.6439 / _ROTOR_TIME},
    "b": {"p": -1.0, "b": -1 / _ROTOR_TIME, "a": 0.3681 / _ROTOR_TIME, "d": 0.7103 / _ROTOR_TIME},
    "w": {"a": -9.748, "b": -131.2, "w": -0.6141, "r": 0.9303},
    "r": {"v": 0.03013, "w": 0.08568, "p": -3.525, "r": -4.129, "rfb": -33.07},
    "rfb": {"r": 2.163, "rfb": -8.258},
    "c": {"q": -1.0, "c": -1 / _BAR_TIME},
    "d": {"p": -1.0, "d": -1 / _BAR_TIME},
    "psi": {"r": 1.0},
    "h": {"w": -1.0},
}
_INPUT_DERIVATIVES = {
    "a": {"lat": 0.03127 / _ROTOR_TIME, "lon": -0.1004 / _ROTOR_TIME},
    "b": {"lat": 0.1398 / _ROTOR_TIME, "lon": 0.0138 / _ROTOR_TIME},
    "w": {"col": -45.84},
    "r": {"ped": 33.07, "col": -3.329},
    "c": {"lon": -0.2587 / _BAR_TIME},
    "d": {"lat": 0.2731 / _BAR_TIME},
}


class UndetectableError(ValueError):
    """No filter can follow these states: something that does not decay is not seen by the measurements."""


class LinearRangeWarning(UserWarning):
    """The helicopter left the range in which a linear filter may be believed."""


@dataclass(frozen=True)
class LinearModel:
    """``x' = A x + B u``, SI.

    Attributes
    ----------
    A : (n, n)
    B : (n, 4)
    states : tuple of str
    """

    A: np.ndarray
    B: np.ndarray
    states: tuple

    def select(self, names):
        """Return the rows of ``y = C x`` that pick the named states, (len(names), n)."""
        return np.eye(len(self.states))[[self.states.index(name) for name in names]]


@dataclass(frozen=True)
class KalmanBucy:
    """A steady continuous Kalman filter ``x' = A x + B u + L (y - C x)``; C picks what is measured.

    Attributes
    ----------
    model : LinearModel
        What it believes of the helicopter.
    gain : (n, m), 1/s
    covariance : (n, n)
        Of the error of the state.
    """

    model: LinearModel
    gain: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class LinearisingController:
    """``u = forward @ reference - feedback @ x``; the outputs then follow ``(rate / (s + rate))^degree``.

    Attributes
    ----------
    feedback : (4, n)
    forward : (4, 4)
        For references of :data:`OUTPUTS`.
    degrees : tuple of int
        How often each output is differentiated until the inputs appear.
    """

    feedback: np.ndarray
    forward: np.ndarray
    degrees: tuple


@dataclass(frozen=True)
class HelicopterRun:
    """A simulated flight, N samples; angles in rad, heights in m.

    Attributes
    ----------
    time : (N,), s
    state : (N, 15)
    control : (N, 4)
    measured, filtered : (N, 4)
        Of :data:`OUTPUTS`, with noise, and as the filter has them.
    """

    time: np.ndarray
    state: np.ndarray
    control: np.ndarray
    measured: np.ndarray
    filtered: np.ndarray

    @property
    def output(self):
        """The true :data:`OUTPUTS`, (N, 4)."""
        return self.state[:, [STATES.index(name) for name in OUTPUTS]]


def r50_hover(*, heading_and_height=True):
    """Return the :class:`LinearModel` of the R-50 in hover, with 15 states or the 13 identified ones."""
    states = STATES if heading_and_height else STATES[:_IDENTIFIED_STATES]
    A = np.array([[_STATE_DERIVATIVES[row].get(column, 0.0) for column in states] for row in states])
    B = np.array([[_INPUT_DERIVATIVES.get(row, {}).get(column, 0.0) for column in INPUTS] for row in states])
    metres = np.array([_FOOT if name in ("u", "v", "w", "h") else 1.0 for name in states])
    return LinearModel(metres[:, None] * A / metres, metres[:, None] * B, states)


def relative_degrees(model, outputs=OUTPUTS):
    """Return how often each output must be differentiated until an input appears.

    Raises
    ------
    ValueError
        Naming an output that no input reaches.
    """
    return tuple(_relative_degree(model, name) for name in outputs)


def _relative_degree(model, output):
    row, = model.select([output])
    for degree in range(1, len(model.states) + 1):
        if np.any(row @ model.B):
            return degree
        row = row @ model.A
    raise ValueError(f"no input reaches {output}")


def decoupling(model, outputs=OUTPUTS):
    """Return the input matrix (4, 4) of the outputs' highest derivatives, and their rows on the state (4, n)."""
    rows = [row @ np.linalg.matrix_power(model.A, degree - 1)
            for row, degree in zip(model.select(outputs), relative_degrees(model, outputs), strict=True)]
    return np.array(rows) @ model.B, np.array(rows) @ model.A


def linearising_controller(model, rates=(4.0, 4.0, 2.0, 1.5)):
    """Return the controller that makes each output a chain of equal lags.

    Parameters
    ----------
    model : LinearModel
        With heading and height.
    rates : (4,)
        Of :data:`OUTPUTS`, rad/s.
    """
    degrees = relative_degrees(model)
    inputs, highest = decoupling(model)
    wanted = np.zeros_like(highest)
    for i, (row, degree, rate) in enumerate(zip(model.select(OUTPUTS), degrees, rates, strict=True)):
        # (s + rate)^degree without its leading term, on the output and its derivatives.
        for factor in np.poly([-rate] * degree)[:0:-1]:
            wanted[i] += factor * row
            row = row @ model.A
    forward = np.linalg.solve(inputs, np.diag(np.power(rates, degrees)))
    return LinearisingController(np.linalg.solve(inputs, highest + wanted), forward, degrees)


def zero_dynamics(model):
    """Return the eigenvalues of what is left inside when the outputs are held at zero, sorted by real part."""
    inputs, highest = decoupling(model)
    held = model.A - model.B @ np.linalg.solve(inputs, highest)
    derivatives = np.array([row @ np.linalg.matrix_power(model.A, k)
                            for row, degree in zip(model.select(OUTPUTS), relative_degrees(model), strict=True)
                            for k in range(degree)])
    inside = np.linalg.svd(derivatives)[2][len(derivatives):]
    return np.sort_complex(np.linalg.eigvals(inside @ held @ inside.T))


def kalman_bucy(model, outputs, process_density, measurement_density):
    """Return the steady Kalman-Bucy filter (the paper's equations 28 to 31).

    Parameters
    ----------
    model : LinearModel
    outputs : sequence of str
        The m states that are measured.
    process_density : (n, n)
        Spectral density W of the noise on ``x'``.
    measurement_density : (m, m)
        Spectral density V of the measurements' noise; of samples, their covariance times the interval.

    Raises
    ------
    UndetectableError
        Naming how many modes that do not decay are not seen, and their eigenvalues.
    """
    from scipy.linalg import solve_continuous_are

    A, C = model.A, model.select(outputs)
    unseen = [value for value in np.linalg.eigvals(A) if value.real > -1e-9
              and np.linalg.matrix_rank(np.vstack([value * np.eye(len(A)) - A, C]), tol=1e-9) < len(A)]
    if unseen:
        values = ", ".join(f"{value if value.imag else value.real + 0.0:.2g}" for value in unseen)
        raise UndetectableError(
            f"not detectable: {', '.join(outputs)} do not show {len(unseen)} of the {len(A)} modes, whose eigenvalues "
            f"{values} do not decay; measure them or leave their states out")
    covariance = solve_continuous_are(A.T, C.T, process_density, measurement_density)
    return KalmanBucy(model, np.linalg.solve(measurement_density, C @ covariance).T, covariance)


def fly(model, controller, reference, *, duration, interval, rng, kalman=None, measurement_std=(0.0, 0.0, 0.0, 0.0),
        process_density=None, nonlinear=False):
    """Simulate a flight from trim.

    Parameters
    ----------
    model : LinearModel
        With heading and height.
    controller : LinearisingController
    reference : (4,) or (N, 4)
        Wanted :data:`OUTPUTS`, rad and m.
    duration, interval : float, s
        The sticks are held through an interval, short against the filter, whose gain it multiplies.
    rng : numpy.random.Generator
    kalman : KalmanBucy, optional
        Measuring :data:`OUTPUTS`, and feeding the controller; without it the true state does.
    measurement_std : (4,), rad and m
    process_density : (15, 15), optional
        Of the gusts that the plant feels.
    nonlinear : bool
        Whether attitude, gravity and the turning axes obey their nonlinear equations.

    Warns
    -----
    LinearRangeWarning
        There is a filter, and roll or pitch leave :data:`LINEAR_RANGE`.

    Returns
    -------
    HelicopterRun
    """
    C, n = model.select(OUTPUTS), len(model.states)
    count = round(duration / interval)
    reference = np.broadcast_to(reference, (count, len(OUTPUTS)))
    plant = _held(model.A, model.B, interval)
    belief = None if kalman is None else _held(kalman.model.A, kalman.model.B, interval)
    gust_root = np.zeros((n, n)) if process_density is None else _root(interval * process_density)
    x, estimate, rows = np.zeros(n), np.zeros(n), []
    for wanted in reference:
        measured = C @ x + measurement_std * rng.standard_normal(len(C))
        estimate = x if kalman is None else estimate + interval * kalman.gain @ (measured - C @ estimate)
        control = controller.forward @ wanted - controller.feedback @ estimate
        rows.append((x, control, measured, C @ estimate))
        if kalman is not None:
            estimate = belief[0] @ estimate + belief[1] @ control
        x = _nonlinear_step(model, x, control, interval) if nonlinear else plant[0] @ x + plant[1] @ control
        x = x + gust_root @ rng.standard_normal(n)
    run = HelicopterRun(interval * np.arange(count), *(np.array(column) for column in zip(*rows, strict=True)))
    if kalman is not None:
        _warn_beyond_linear(np.abs(run.output[:, :2]).max())
    return run


def _warn_beyond_linear(largest):
    if not largest <= LINEAR_RANGE:
        warnings.warn(f"roll or pitch reached {np.degrees(largest):.0f} deg: beyond {np.degrees(LINEAR_RANGE):.0f} deg "
                      "the linear filter may be worse than the sensor alone", LinearRangeWarning, stacklevel=3)


def _held(A, B, interval):
    """Return the transition over an interval and the effect of inputs held through it."""
    from scipy.linalg import expm

    n, m = B.shape
    both = expm(interval * np.block([[A, B], [np.zeros((m, n + m))]]))
    return both[:n, :n], both[:n, n:]


def _root(covariance):
    """Return a square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _nonlinear_step(model, x, control, interval):
    """Return the state after a Runge-Kutta step of :func:`nonlinear_rate`."""
    k1 = nonlinear_rate(model, x, control)
    k2 = nonlinear_rate(model, x + 0.5 * interval * k1, control)
    k3 = nonlinear_rate(model, x + 0.5 * interval * k2, control)
    k4 = nonlinear_rate(model, x + interval * k3, control)
    return x + interval / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def nonlinear_rate(model, x, control):
    """Return ``x'`` with the linear model's forces and moments, and kinematics and gravity as they are.

    Parameters
    ----------
    model : LinearModel
        With heading and height.
    x : (15,)
    control : (4,)
    """
    rate = model.A @ x + model.B @ control
    u, v, p, q, phi, theta, _, _, w, r = x[:10]
    g = STANDARD_GRAVITY
    linear_g = -model.A[0, 5]
    sp, cp, st, ct = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta)
    turning = q * sp + r * cp
    rate[0] += linear_g * theta - g * st + r * v - q * w
    rate[1] += -linear_g * phi + g * sp * ct + p * w - r * u
    rate[8] += g * (cp * ct - 1) + q * u - p * v
    rate[4] = p + turning * st / ct
    rate[5] = q * cp - r * sp
    rate[13] = turning / ct
    rate[14] = u * st - (v * sp + w * cp) * ct
    return rate


# --- a flight as a function of time -------------------------------------------------------------------

_TERMS = 24  # of power series over at most _LONGEST seconds, in which the helicopter forgets a third of its speed
_LONGEST = 5.0
_PROFILE_DEGREE = 7


def helicopter_flight(knots, roll, pitch, turn_rate, up):
    """Return the motion of the controlled helicopter as a function of time.

    The controller takes roll, pitch, heading and height along any path that is differentiable often enough: three
    times, as :class:`inertial.trajectory.Profile` is. What remains, the velocities along and across the heading,
    follow from the zero dynamics of the linear model, drag and rotor force included, as power series.

    Parameters
    ----------
    knots : (K,), s
        Of all the profiles; the motion holds from the first to the last.
    roll, pitch, turn_rate, up : inertial.trajectory.Profile
        Of time; rad, rad, rad/s, m/s; at rest at the first knot.
    """
    starts, series = _drift_series(np.asarray(knots, dtype=float), roll, pitch)

    def motion(t):
        psi, psi_rate = turn_rate.integral(t), turn_rate(t)
        piece = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(starts) - 1)
        since = np.maximum(t - starts[piece], 0.0)
        forward, right, forward_rate, right_rate = _sum_series(series[piece], since)
        sine, cosine = np.sin(psi), np.cos(psi)
        along, across = forward_rate - psi_rate * right, right_rate + psi_rate * forward
        return Motion(
            roll(t), pitch(t), psi, roll(t, 1), pitch(t, 1), psi_rate,
            np.stack([cosine * forward - sine * right, sine * forward + cosine * right, -up(t)], axis=-1),
            np.stack([cosine * along - sine * across, sine * along + cosine * across, -up(t, 1)], axis=-1))
    return motion


def _drift_series(knots, roll, pitch):
    """Return when each piece starts, and the power series of its velocities ahead and right, (M, terms, 2)."""
    M, tilt, angular = _zero_dynamics_of_velocity()
    starts = np.concatenate([np.linspace(start, end, int(np.ceil((end - start) / _LONGEST)), endpoint=False)
                             for start, end in zip(knots[:-1], knots[1:], strict=True)])
    series = np.zeros((len(starts), _TERMS + 1, 2))
    factorial = np.cumprod(np.concatenate([[1.0], np.arange(1.0, _PROFILE_DEGREE + 1)]))
    velocity = np.zeros(2)
    for piece, (start, end) in enumerate(zip(starts, np.append(starts[1:], knots[-1]), strict=True)):
        angles = np.zeros((_TERMS + 3, 2))
        angles[:_PROFILE_DEGREE + 1] = [
            [pitch(start, k) / factorial[k], roll(start, k) / factorial[k]] for k in range(_PROFILE_DEGREE + 1)]
        z = series[piece]
        z[0] = velocity
        for k in range(_TERMS):
            drive = tilt * angles[k] + angular * (k + 2) * (k + 1) * angles[k + 2]
            z[k + 1] = (M @ z[k] + drive) / (k + 1)
        velocity = np.polynomial.polynomial.polyval(end - start, z)
    return starts, series


def _zero_dynamics_of_velocity():
    """Return ``M``, ``tilt``, ``angular`` of ``z' = M z + tilt (theta, phi) + angular (theta'', phi'')``, z = (u, v).

    Pitch and roll being given, their second derivatives say how far the rotor flaps, and that its force.
    """
    A = r50_hover().A
    at = {name: STATES.index(name) for name in STATES}
    velocity = [at["u"], at["v"]]
    flap = np.array([A[at["u"], at["a"]] / A[at["q"], at["a"]], A[at["v"], at["b"]] / A[at["p"], at["b"]]])
    M = A[np.ix_(velocity, velocity)] - flap[:, None] * A[np.ix_([at["q"], at["p"]], velocity)]
    return M, np.array([A[at["u"], at["theta"]], A[at["v"], at["phi"]]]), flap


def _sum_series(series, since):
    """Return the sums (2, ...) and their derivatives (2, ...) of power series (..., terms, 2) at times (...)."""
    value = rate = np.zeros((*np.shape(since), 2))
    for k in range(series.shape[-2] - 1, -1, -1):
        rate = rate * since[..., None] + value
        value = value * since[..., None] + series[..., k, :]
    return *np.moveaxis(value, -1, 0), *np.moveaxis(rate, -1, 0)

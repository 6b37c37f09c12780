"""The paper's closed forms on what a table has measured: dwells at its positions, or a steady rotation.

Each form takes a sensor's readings at a few positions (:data:`alignment.azimuth.METHODS`):

- a table angle in deg: the mean of the dwells there;
- ``"any"``: what the harmonic fit of all dwells says, without the bias, at the angle that tells the heading best;
- ``"maximum"``: the largest rate over a turn, of the same fit;
- ``"tipped"``: the mean of the z axis in place of the tipped sensor.

A table that turns steadily passes every position, and its readings there are those of the fit. The deviations
count white and 1/f noise and the same priors as the joint estimator's.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment import azimuth, levelling
from alignment.harmonic import HarmonicFit, fit_harmonic

POSITIONS = {"0": 0.0, "90": 0.5 * math.pi, "180": math.pi, "270": 1.5 * math.pi}
"""Table angles of the positions that have one, rad."""
FOUR = tuple(POSITIONS)


@dataclass(frozen=True)
class AxisReadings:
    """Readings of a sensor at positions of the table, each a weighted sum of what was measured.

    Attributes
    ----------
    values : (N,) float64
        What was measured: dwells, or the coefficients of a fit.
    covariance : (N, N) float64
    constant : (N,) float64
        What a bias of one adds to the values.
    weights : dict
        Position to (N,) float64.
    angle : dict
        Position to its table angle, rad; there is none of ``"tipped"``.
    every : tuple
        Positions that a least-squares method takes.
    fit : alignment.harmonic.HarmonicFit
        Bias, cosine and sine of the sensor.
    """

    values: np.ndarray
    covariance: np.ndarray
    constant: np.ndarray
    weights: dict
    angle: dict
    every: tuple
    fit: HarmonicFit

    def has(self, positions):
        """Whether there is a reading at each position."""
        return all(position in self.weights for position in positions)

    def at(self, positions, scale_std, turn_std=0.0):
        """Return the readings, (P,), and their covariance, (P, P), scale factor and turn about the axis in it."""
        weights = np.array([self.weights[position] for position in positions])
        readings = weights @ self.values
        signal = readings - weights @ self.constant * self.fit.bias
        cosine, sine = self.fit.in_plane
        angles = [self.angle.get(position) for position in positions]
        slope = np.array([0.0 if angle is None else sine * math.cos(angle) - cosine * math.sin(angle)
                          for angle in angles])
        return readings, (weights @ self.covariance @ weights.T + scale_std ** 2 * np.outer(signal, signal)
                          + turn_std ** 2 * np.outer(slope, slope))


def turning_readings(fit, best_angle=math.nan):
    """Return the readings of a table that turns steadily.

    Parameters
    ----------
    fit : alignment.harmonic.HarmonicFit
        Of one sensor.
    best_angle : float, rad
        That of ``"any"``.
    """
    constant, cosine, sine = np.eye(len(fit.coefficients))[:3]
    weights = {place: constant + math.cos(angle) * cosine + math.sin(angle) * sine
               for place, angle in POSITIONS.items()}
    fitted = _fitted_angles(fit, best_angle)
    weights |= {place: math.cos(angle) * cosine + math.sin(angle) * sine for place, angle in fitted.items()}
    return AxisReadings(fit.coefficients, fit.covariance, constant, weights, POSITIONS | fitted, FOUR, fit)


def dwell_readings(schedule, values, covariance, fit, tolerance, best_angle=math.nan, tipped=None):
    """Return the readings of a table that has stood at angles.

    Parameters
    ----------
    schedule : alignment.sequences.Schedule
        K dwells.
    values : (K,) float64
        Their means of one sensor.
    covariance : (K, K) float64
    fit : alignment.harmonic.HarmonicFit
        Of these.
    tolerance : float, rad
        How near two angles are the same position.
    best_angle : float, rad
        That of ``"any"``.
    tipped : (K,) float64, optional
        Means of the sensor that stands in for the tipped one, with the same covariance.
    """
    count = len(values)
    shares, angle = {}, dict(POSITIONS)
    for place, there in POSITIONS.items():
        near = np.abs(np.remainder(schedule.angle - there + math.pi, 2 * math.pi) - math.pi) <= tolerance
        if near.any():
            shares[place] = near * schedule.duration / schedule.duration[near].sum()
    gain = fit_harmonic(schedule.angle, np.eye(count), covariance).in_plane
    fitted = _fitted_angles(fit, best_angle)
    shares |= {place: gain @ [math.cos(there), math.sin(there)] for place, there in fitted.items()}
    shares |= dict(enumerate(np.eye(count)))
    angle |= fitted | dict(enumerate(schedule.angle))
    constant = np.ones(count)
    if tipped is not None:
        none = np.zeros(count)
        shares = {place: np.concatenate([share, none]) for place, share in shares.items()}
        shares["tipped"] = np.concatenate([none, schedule.duration / schedule.duration.sum()])
        values, constant = np.concatenate([values, tipped]), np.ones(2 * count)
        covariance = np.block([[covariance, np.zeros_like(covariance)], [np.zeros_like(covariance), covariance]])
    return AxisReadings(values, covariance, constant, shares, angle, tuple(range(count)), fit)


def _fitted_angles(fit, best_angle):
    cosine, sine = fit.in_plane
    angles = {"maximum": math.atan2(sine, cosine)}
    return angles if math.isnan(best_angle) else angles | {"any": best_angle}


def compare_headings(gyro, level, params, names=tuple(azimuth.METHODS), hint=None):
    """Return the heading by every closed form whose positions there are: name to result.

    Parameters
    ----------
    gyro : AxisReadings
    level : alignment.results.LevelResult
    params : alignment.params.AlignmentParams
    names : iterable of str
        Methods wanted.
    hint : float, optional
        Heading by a compass or the joint estimator, rad, that chooses among branches.
    """
    turn_std = math.hypot(params.skew_std, params.table_zero_std)
    results = {}
    for name, method in azimuth.METHODS.items():
        if name in names and gyro.has(method.positions):
            rates, covariance = gyro.at(method.positions, params.scale_std, turn_std)
            results[name] = azimuth.find_azimuth(
                name, rates, level.roll, level.pitch, params.latitude, angle=gyro.angle.get("any", 0.0),
                rate_covariance=covariance, level_covariance=level.covariance,
                latitude_std=params.latitude_std, hint=hint, shared_channel="tipped" in method.positions)
    return results


def compare_levels(accel_x, accel_y, params):
    """Return the level by every levelling method whose positions there are: name to result.

    Parameters
    ----------
    accel_x, accel_y : AxisReadings
    params : alignment.params.AlignmentParams
    """
    gravity, results = params.local_gravity, {}

    def forces(readings, positions):
        return readings.at(positions, params.accel_scale_std)

    if accel_x.has(FOUR):
        for name, method, axis in (("levelling_1", levelling.levelling_1, accel_x),
                                   ("levelling_3", levelling.levelling_3, accel_y)):
            readings, covariance = forces(axis, FOUR)
            results[name] = method(readings, gravity, covariance)
    for name, method, axis in (("levelling_2", levelling.levelling_2, accel_x),
                               ("levelling_4", levelling.levelling_4, accel_y)):
        readings, covariance = forces(axis, axis.every)
        results[name] = method([axis.angle[place] for place in axis.every], readings, gravity, covariance)
    tipped = ("0", "90", "180", "tipped")
    if accel_x.has(tipped):
        readings, covariance = forces(accel_x, tipped)
        # The z accelerometer has a bias and a scale factor of its own.
        covariance[3, 3] += 2 * (params.accel_bias_std ** 2 + (params.accel_scale_std * readings[3]) ** 2)
        results["levelling_5"] = levelling.levelling_5(readings[:3], readings[3], gravity, covariance,
                                                       shared_channel=True)
    return dict(sorted(results.items()))

"""Harmonic fit, joint estimator and bounds: closed forms, efficiency, consistency, disturbances."""

import numpy as np
import pytest

from alignment import bounds, sequences
from alignment.errors import NotEnoughDataError, UnobservableError
from alignment.harmonic import fit_harmonic
from alignment.north import explain_scale, find_north
from alignment.params import NorthPriors
from alignment.results import UNBELIEVABLE, Quality, wrap_angle
from alignment.turntable import (
    TriadErrors,
    Turntable,
    earth_direction_t,
    exact_readings,
    simulate_readings,
)
from inertial.earth import EARTH_RATE

EXACT = 1e-12  # rad, ideal sensors
EFFICIENCY = 1.10  # heading RMS over the best-design bound
TRIALS = 1000
SCATTER = 4.5 * np.sqrt(2 / TRIALS)  # relative scatter of a mean square from as many trials
DEG = np.pi / 180
DEG_PER_HOUR = DEG / 3600
NAVIGATION = 0.003 * DEG / 60  # angle random walk, rad/s/sqrt(Hz)
TIGHT = NorthPriors(2e-5, 2.4e-5, 0.0, 0.0)
NO_TILT = np.zeros((2, 2))
PERFECT = TriadErrors()
ATTITUDES = [(0, 0, 0, 35), (0, 0, 90, 60), (50, 30, 88, 35), (20, -15, 200, -45), (80, 10, 40, 35)]


def _table(roll, pitch, heading, latitude, **errors):
    return Turntable(roll * DEG, pitch * DEG, heading * DEG, latitude * DEG, **errors)


def _north_of(table, schedule, readings, noise_density, priors=TIGHT, y_gyro=False, **options):
    variance = noise_density ** 2 / schedule.duration
    fits = [fit_harmonic(schedule.angle, readings.gyro_b[..., axis], variance, **options)
            for axis in (0, 1)]
    return find_north(fits[0], fits[1] if y_gyro else None, [table.roll, table.pitch], NO_TILT,
                      table.latitude, priors)


def _errors(result, table):
    return wrap_angle(result.heading - table.heading)


@pytest.mark.parametrize("y_gyro", [False, True])
@pytest.mark.parametrize("attitude", ATTITUDES)
def test_exact_with_ideal_sensors(attitude, y_gyro):
    table = _table(*attitude)
    schedule = sequences.palindrome(600.0)
    result = _north_of(table, schedule, exact_readings(table, schedule.angle), NAVIGATION, y_gyro=y_gyro)
    assert abs(_errors(result, table)) < EXACT
    assert result.flags == Quality(0)


def test_harmonic_fit_finds_its_coefficients():
    angle = np.linspace(0, 5, 9)
    time, rate = np.arange(9.0), np.array([1, -1, 1, -1, 1, 1, 1, -1, 1.0])
    value = 1 + 2 * np.cos(angle) + 3 * np.sin(angle) + 0.1 * time + 0.2 * rate
    fit = fit_harmonic(angle, value, 1.0, time=time, rate=rate)
    assert fit.coefficients == pytest.approx([1, 2, 3, 0.1, 0.2], abs=1e-12)
    assert (fit.freedom, fit.chi2) == (4, pytest.approx(0.0, abs=1e-20))


def test_harmonic_covariance_and_chi2_are_those_of_a_monte_carlo():
    angle, deviation = np.linspace(0, 5, 9), np.linspace(0.5, 1.5, 9)
    value = deviation * np.random.default_rng(1).standard_normal((TRIALS, 9))
    fit = fit_harmonic(angle, value, deviation ** 2)
    assert np.var(fit.coefficients, axis=0) / np.diag(fit.covariance) == pytest.approx(1.0, abs=SCATTER)
    assert fit.chi2.mean() / fit.freedom == pytest.approx(1.0, abs=SCATTER)
    full = fit_harmonic(angle, value, np.diag(deviation ** 2))
    assert full.coefficients == pytest.approx(fit.coefficients, abs=1e-12)


@pytest.mark.parametrize("angles, rank", [([0.0, np.pi], 2), ([0.0, 0.0, np.pi], 2), ([1.0] * 5, 1),
                                          ([0.0, 1e-5, 2e-5], 2)])
def test_too_few_or_equal_angles_are_refused_with_the_rank(angles, rank):
    with pytest.raises(NotEnoughDataError, match=f"tell {rank} of 3 .*condition number"):
        fit_harmonic(angles, np.zeros(len(angles)), 1.0)


def test_outliers_cost_less_than_ten_percent():
    rng = np.random.default_rng(2)
    angle = np.repeat(sequences.FOUR_POSITIONS, 50)
    clean = np.cos(angle) + 0.1 * rng.standard_normal((300, len(angle)))
    outlier = rng.random(clean.shape) < 0.05
    value = np.where(outlier, clean + 5.0 * rng.standard_normal(clean.shape), clean)
    plain = fit_harmonic(angle, value, 0.01).in_plane
    robust = np.array([fit_harmonic(angle, row, 0.01, robust=True).in_plane for row in value])
    truth = np.array([1.0, 0.0])
    deviation = np.sqrt(np.mean((fit_harmonic(angle, clean, 0.01).in_plane - truth) ** 2))
    assert np.sqrt(np.mean((robust - truth) ** 2)) < 1.10 * deviation
    assert np.sqrt(np.mean((plain - truth) ** 2)) > 5 * deviation


def test_robust_fit_with_unknown_noise_states_its_covariance():
    rng = np.random.default_rng(3)
    angle = np.repeat(sequences.FOUR_POSITIONS, 2000)
    value = np.cos(angle) + 0.1 * rng.standard_normal(len(angle))
    value[::20] += 5.0
    fit = fit_harmonic(angle, value, robust=True)
    assert np.diag(fit.in_plane_covariance) == pytest.approx(0.01 / 3800, rel=0.05)
    assert not fit.kept[::20].any()


def _x_rates(roll, pitch, heading, latitude, angle):
    """Return exact rates of the x gyro: attitudes in rad broadcast against angles."""
    x, y, _ = np.moveaxis(earth_direction_t(roll, pitch, heading, latitude), -1, 0)
    return EARTH_RATE * (x[..., None] * np.cos(angle) + y[..., None] * np.sin(angle))


def _refined_errors(attitude, trials):
    """Return heading errors over the best-design bound and over their stated deviation, (trials, 2)."""
    roll, pitch, heading, latitude = np.radians(attitude)
    total, rng = 600.0, np.random.default_rng(4)
    coarse = sequences.single_pass(sequences.COARSE_SHARE * total)

    def measure(schedule):
        noise = NAVIGATION / np.sqrt(schedule.duration) * rng.standard_normal(len(schedule.angle))
        return _x_rates(roll, pitch, heading, latitude, schedule.angle) + noise + 1e-7

    def solve(schedule, rates):
        fit = fit_harmonic(schedule.angle, rates, NAVIGATION ** 2 / schedule.duration)
        return find_north(fit, None, [roll, pitch], NO_TILT, latitude, TIGHT)
    bound = bounds.heading_bound(NAVIGATION, total, bounds.sensitivity(roll, pitch, heading, latitude))
    errors = np.empty((trials, 2))
    for trial in range(trials):
        first = measure(coarse)
        best = bounds.best_angle(roll, pitch, solve(coarse, first).heading, latitude)
        fine = sequences.indexed_schedule([best, best + np.pi], 0.375 * total, start=150.0)
        result = solve(sequences.joined(coarse, fine), np.concatenate([first, measure(fine)]))
        errors[trial] = wrap_angle(result.heading - heading) / np.array([bound, result.std])
    return errors


def test_refined_sequence_reaches_the_best_design_at_every_attitude():
    """All attitudes together closely, each by itself as closely as its trials allow; 4000 each are in the study."""
    squares = np.array([np.mean(_refined_errors(attitude, TRIALS // 4) ** 2, axis=0) for attitude in ATTITUDES])
    efficiency, consistency = squares.mean(axis=0)
    assert np.sqrt(efficiency) < EFFICIENCY + 0.5 * SCATTER
    assert consistency == pytest.approx(1.0, abs=SCATTER)
    assert np.sqrt(squares[:, 0]).max() < EFFICIENCY + SCATTER  # a quarter of the trials: twice the scatter
    np.testing.assert_allclose(squares[:, 1], 1.0, atol=2 * SCATTER)


@pytest.mark.parametrize("y_gyro", [False, True])
@pytest.mark.parametrize("attitude", ATTITUDES)
def test_error_is_as_stated_with_every_prior_perturbed(attitude, y_gyro):
    rng = np.random.default_rng(5)
    priors = NorthPriors(scale_std=3e-4, skew_std=3e-4, table_zero_std=3e-4, latitude_std=3e-4)
    tilt_std = 3e-4
    roll, pitch, heading, latitude = np.radians(attitude)
    schedule = sequences.palindrome(600.0)
    variance = NAVIGATION ** 2 / schedule.duration

    def scattered(std, *shape):
        return std * rng.standard_normal((TRIALS, *shape))
    actual = (roll + scattered(tilt_std), pitch + scattered(tilt_std), heading,
              latitude + scattered(priors.latitude_std))
    zero = scattered(priors.table_zero_std, 1)
    fits = []
    for turn in (0.0, 0.5 * np.pi):
        angle = schedule.angle + turn + zero + scattered(priors.skew_std, 1)
        rates = (1 + scattered(priors.scale_std, 1)) * _x_rates(*actual, angle)
        noise = np.sqrt(variance) * rng.standard_normal(rates.shape)
        fits.append(fit_harmonic(schedule.angle, rates + noise, variance))
    result = find_north(fits[0], fits[1] if y_gyro else None, [roll, pitch], tilt_std ** 2 * np.eye(2),
                        latitude, priors)
    normalised = wrap_angle(result.heading - heading) / result.std
    assert np.mean(normalised ** 2) == pytest.approx(1.0, abs=SCATTER)


def _branches(rng, count, tilt_deg):
    """Return errors, stated deviations and flags over random attitudes with tilt in a range, deg."""
    schedule = sequences.single_pass(600.0)
    low, high = np.cos(np.radians(tilt_deg))
    tilt, azimuth = np.arccos(rng.uniform(low, high, count)), rng.uniform(-np.pi, np.pi, count)
    down = np.stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)], axis=-1)
    roll, pitch = np.arctan2(down[:, 1], down[:, 2]), -np.arcsin(down[:, 0])
    heading = rng.uniform(-np.pi, np.pi, count)
    latitudes = np.radians(np.arange(-60, 61, 15))
    results = []
    for latitude, chosen in zip(latitudes, np.array_split(np.arange(count), len(latitudes)), strict=True):
        rates = _x_rates(roll[chosen], pitch[chosen], heading[chosen], latitude, schedule.angle)
        variance = NAVIGATION ** 2 / schedule.duration
        rates = rates + np.sqrt(variance) * rng.standard_normal(rates.shape)
        result = find_north(fit_harmonic(schedule.angle, rates, variance), None,
                            np.stack([roll, pitch], -1)[chosen], NO_TILT, latitude, TIGHT)
        flagged = result.quality & UNBELIEVABLE.value != 0
        results.append((wrap_angle(result.heading - heading[chosen]), result.std, flagged))
    return [np.concatenate(parts) for parts in zip(*results, strict=True)]


def test_no_wrong_branch_within_thirty_degrees_of_level():
    error, std, flagged = _branches(np.random.default_rng(6), 10000, (30, 0))
    assert not np.any((np.abs(error) > 6 * std) & ~flagged)
    assert flagged.mean() <= 0.02


def test_hardly_a_wrong_branch_goes_unflagged_near_ninety_degrees():
    error, std, flagged = _branches(np.random.default_rng(7), 5000, (95, 85))
    wrong = ~(np.abs(error) <= 6 * std)
    assert np.mean(wrong & ~flagged) <= 0.002
    assert flagged.mean() > 0.01, "no attitude here is hard"


def test_two_headings_that_explain_the_same_are_ambiguous():
    table, schedule = _table(90, 0, 40, 35), sequences.palindrome(600.0)
    result = _north_of(table, schedule, exact_readings(table, schedule.angle), NAVIGATION)
    assert Quality.AMBIGUOUS in result.flags
    assert np.sort(np.degrees(result.branches)) == pytest.approx([-40, 40], abs=1e-6)


@pytest.mark.parametrize("latitude, flag", [(82, Quality.WEAK), (-82, Quality.WEAK), (60, Quality(0))])
def test_high_latitudes_are_weak(latitude, flag):
    table, schedule = _table(0, 0, 10, latitude), sequences.palindrome(600.0)
    assert _north_of(table, schedule, exact_readings(table, schedule.angle), NAVIGATION).flags == flag


@pytest.mark.parametrize("latitude", [0.5 * np.pi, -1.5703])
def test_a_pole_has_no_north(latitude):
    fit = fit_harmonic(sequences.FOUR_POSITIONS, np.zeros(4), 1.0)
    with pytest.raises(UnobservableError, match="pole"):
        find_north(fit, None, [0.0, 0.0], NO_TILT, latitude, TIGHT)


def test_wrong_arguments_are_named():
    fit = fit_harmonic(sequences.FOUR_POSITIONS, np.zeros(4), 1.0)
    with pytest.raises(ValueError, match="latitude = nan"):
        find_north(fit, None, [0.0, 0.0], NO_TILT, float("nan"), TIGHT)
    with pytest.raises(ValueError, match="neither"):
        find_north(None, None, [0.0, 0.0], NO_TILT, 0.6, TIGHT)


@pytest.mark.parametrize("factor, words", [(180 / np.pi, "deg/s"), (1.3, "base turns"), (3600 * 180 / np.pi,
                                                                                         "arcsec/s")])
def test_a_wrong_unit_is_flagged_and_explained(factor, words):
    table, schedule = _table(5, 5, 40, 35), sequences.palindrome(600.0)
    readings = exact_readings(table, schedule.angle)
    fit = fit_harmonic(schedule.angle, factor * readings.gyro_b[:, 0], NAVIGATION ** 2 / schedule.duration)
    result = find_north(fit, None, [table.roll, table.pitch], NO_TILT, table.latitude, TIGHT)
    assert Quality.SCALE in result.flags
    assert words in explain_scale(result.scale)


def test_palindrome_cancels_drift():
    table = _table(0, 0, 30, 35)
    drift = TriadErrors(drift=(DEG_PER_HOUR / 3600,) * 3)
    rng = np.random.default_rng(8)

    def error_deg(schedule, **options):
        readings = simulate_readings(table, schedule, drift, PERFECT, rng)
        return np.degrees(_errors(_north_of(table, schedule, readings, NAVIGATION, **options), table))
    assert abs(error_deg(sequences.palindrome(600.0))) < 0.01
    once = sequences.indexed_schedule(sequences.FOUR_POSITIONS * 10, 15.0)
    slow = sequences.single_pass(600.0)
    assert abs(error_deg(slow)) > 0.2
    for schedule in (once, sequences.palindrome(600.0)):
        assert abs(error_deg(schedule, time=schedule.middle)) < 1e-6


def test_wobble_cancels_when_the_table_turns_both_ways():
    table = _table(0, 0, 0, 35, wobble=DEG / 3600)
    for both_ways, low, high in ((False, 0.9, 1.0), (True, 0.0, 0.001)):
        schedule = sequences.continuous_rotation(6 * DEG, 120.0, 0.1, both_ways)
        readings = exact_readings(table, schedule.angle, schedule.rate)
        error = np.degrees(abs(_errors(_north_of(table, schedule, readings, NAVIGATION), table)))
        assert low <= error <= high


@pytest.mark.parametrize("attitude", ATTITUDES)
@pytest.mark.parametrize("make", [sequences.single_pass, sequences.palindrome])
def test_prediction_is_what_a_monte_carlo_finds(attitude, make):
    table, schedule = _table(*attitude), make(600.0)
    noise = TriadErrors(noise_density=NAVIGATION, bias_instability=0.01 * DEG_PER_HOUR)
    readings = simulate_readings(table, schedule, noise, PERFECT, np.random.default_rng(9), TRIALS)
    found = _errors(_north_of(table, schedule, readings, NAVIGATION), table)
    predicted = bounds.predicted_heading_std(schedule, NAVIGATION, noise.bias_instability, table.roll,
                                             table.pitch, table.heading, table.latitude)
    assert np.mean(found ** 2) / predicted ** 2 == pytest.approx(1.0, abs=SCATTER)


def test_flicker_covariance_is_that_of_noise_made_in_the_frequency_domain():
    rng = np.random.default_rng(10)
    count, dwells, instability = 4096, 4, 1.0
    # One-sided periodic noise with two-sided density B^2 / (2 pi f), the floor being 0.664 B.
    strength = instability ** 2 * np.pi / (2 * np.log(2))
    frequency = np.arange(1, count // 2) / count
    deviation = np.sqrt(strength / (2 * np.pi * frequency) / count)
    shape = (TRIALS, len(frequency))
    spectrum = np.zeros((TRIALS, count // 2 + 1), dtype=complex)
    complex_normal = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    spectrum[:, 1:-1] = deviation * complex_normal / np.sqrt(2)
    noise = np.fft.irfft(spectrum, count) * count
    # A short part of the period, which its periodicity hardly reaches.
    means = noise[:, :count // 16].reshape(TRIALS, dwells, -1).mean(axis=-1)
    schedule = sequences.indexed_schedule(np.zeros(dwells), count / 16 / dwells)
    expected = bounds.flicker_covariance(schedule, instability)
    for weights in ([1, 0, -1, 0], [1, -1, 0, 0], [1, -1, -1, 1]):
        weights = np.array(weights)
        assert np.var(means @ weights) / (weights @ expected @ weights) == pytest.approx(1.0, abs=SCATTER)


def test_the_bound_is_that_of_the_best_two_angles():
    table = _table(50, 30, 88, 35)
    best = bounds.best_angle(table.roll, table.pitch, table.heading, table.latitude)
    reach = bounds.sensitivity(table.roll, table.pitch, table.heading, table.latitude)
    step = 1e-6
    slope = np.diff([exact_readings(_table(50, 30, 88 + turn / DEG, 35), best).gyro_b[0]
                     for turn in (-step, step)])[0] / (2 * step)
    assert abs(slope) == pytest.approx(EARTH_RATE * reach, rel=1e-6)
    bound = bounds.heading_bound(NAVIGATION, 100.0, reach)
    assert bound == pytest.approx(NAVIGATION / 10 / abs(slope), rel=1e-6)
    level = bounds.best_angle(0.0, 0.0, 0.3, 0.6)
    assert abs(np.cos(level + 0.3)) == pytest.approx(0.0, abs=EXACT)

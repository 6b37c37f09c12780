"""Biases that are known from before: how they age, and an estimator that starts with them."""

import math

import numpy as np

from attitude_estimator import _kernels as kernels


def aged_gyro_bias(bias, std, age, params):
    """Return a gyro bias and its spread some time later.

    It has walked by ``gyro_bias_walk`` since, and is then weighed against the prior of any switch-on, zero with
    ``gyro_bias_std``, which is all that is left of it in the end.

    Parameters
    ----------
    bias, std : (3,), rad/s
    age : float, s
    params : AttitudeParams

    Returns
    -------
    bias, std : (3,), rad/s
    """
    walked = np.square(std) + age * params.gyro_bias_walk ** 2
    share = params.gyro_bias_std ** 2 / (params.gyro_bias_std ** 2 + walked)
    return share * np.asarray(bias), np.sqrt(share * walked)


def aged_accel_bias(bias, std, age, params):
    """Return an accelerometer bias and its spread some time later: that of a Gauss-Markov process, m/s^2."""
    decay = math.exp(-age / params.accel_bias_time)
    variance = decay ** 2 * np.square(std) + (1.0 - decay ** 2) * params.accel_bias_std ** 2
    return decay * np.asarray(bias), np.sqrt(variance)


def start_with_biases(estimator, gyro_bias_b, gyro_bias_std, accel_bias_b, accel_bias_std):
    """Start a ``dcm_row`` estimator anew with known biases.

    Parameters
    ----------
    estimator : AttitudeEstimator
    gyro_bias_b, gyro_bias_std : (3,), rad/s, FRD
    accel_bias_b, accel_bias_std : (3,), m/s^2, FRD

    Raises
    ------
    ValueError
        The estimator has no biases.
    """
    if estimator.params.estimator != "dcm_row":
        raise ValueError(f"estimator = {estimator.params.estimator!r}: only dcm_row has biases to start with")
    estimator.reset()
    memory = estimator._memory  # of this package; the estimator's own start is blind
    memory[kernels.X + kernels.BG:kernels.X + kernels.N] = np.concatenate([gyro_bias_b, accel_bias_b])
    diagonal = kernels.P + (kernels.N + 1) * np.arange(kernels.BG, kernels.N)
    memory[diagonal] = np.square(np.concatenate([gyro_bias_std, accel_bias_std]))

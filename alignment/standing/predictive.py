"""The error model and the incremental predictive algorithm (IPA) by themselves, for studies and tests.

The filters of :mod:`alignment.standing.filters` run the same compiled functions. With ``S_i = sum_{j<i} F^j``, horizon
p and weights Ry = r, Qm = 1, the algorithm minimises over increments ``Dm`` of the model error

``J = sum_i r |free_i + (Hy Dm)_i|^2 + |Dm|^2``,   ``Hy_ij = H S_{i-j+1} Ts``,

of which the minimum is at ``Dm* = -Hy^T (Hy Hy^T + I / r)^-1 free`` and ``J* = free^T (Hy Hy^T + I / r)^-1 free``.
"""

from dataclasses import dataclass

import numpy as np

from alignment.standing import _kernels as kernels


@dataclass(frozen=True)
class PredictiveGain:
    """What one computation of the gain leaves, for Qm = 1.

    Attributes
    ----------
    rows : (p, 2, 5) float64
        ``H S_i``.
    gain : (5, 2 p) float64
        First block row of K: the first increment is ``-gain @ free``.
    weight : (2 p, 2 p) float64
        ``(Hy Hy^T + I / r)^-1``: the cost is ``free @ weight @ free``.
    """

    rows: np.ndarray
    gain: np.ndarray
    weight: np.ndarray


def predictive_gain(F, dt, horizon, weight_ratio):
    """Return the :class:`PredictiveGain` of a transition matrix F (5, 5), a sample interval dt, s, and r = Ry/Qm."""
    p = horizon
    found = PredictiveGain(np.zeros((p, 2, 5)), np.zeros((5, 2 * p)), np.zeros((2 * p, 2 * p)))
    kernels.fill_gain(p, float(weight_ratio), float(dt), np.ascontiguousarray(F, dtype=float),
                      found.rows, found.gain, found.weight)
    return found


def error_rate(x, force, dcm_computed, params):
    """Return the rate of the error model, (5,) or (10,).

    Parameters
    ----------
    x : (5,) or (10,)
        dvN, dvE, phiN, phiE, phiD; with ten also gyro bias (3) and accelerometer bias x and y, body axes.
    force : (3,), m/s^2
        Specific force in computed axes.
    dcm_computed : (3, 3)
        Computed attitude.
    params : StandingParams
    """
    rate = np.zeros(len(x))
    kernels.model_rate(params.constants(), len(x), np.asarray(x, dtype=float), np.asarray(force, dtype=float),
                       np.ascontiguousarray(dcm_computed, dtype=float), rate)
    return rate


def error_jacobian(x, force, dcm_computed, params):
    """Return the Jacobian of :func:`error_rate`, the force held fixed; mended or the paper's, as in the parameters."""
    A = np.zeros((len(x), len(x)))
    kernels.model_jacobian(params.constants(), len(x), np.asarray(x, dtype=float), np.asarray(force, dtype=float),
                           np.ascontiguousarray(dcm_computed, dtype=float), A)
    return A

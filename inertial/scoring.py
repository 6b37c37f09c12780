"""How good an attitude is: the angle between the estimated and the true down direction.

Heading takes no part: only the down direction in body axes is compared, so a truth with arbitrary
heading serves. The first seconds after the first estimate are left out (``settle``), and so is every
stamp that the truth does not span closely. Stamps at which the filter says that it has no attitude
count as not covered by its covariance and take no other part.
"""

from dataclasses import dataclass

import numpy as np

from inertial.rotation import (
    dcm_from_quaternion,
    down_from_quaternion,
    quaternion_slerp,
    roll_pitch_from_down,
)

_SETTLE = 5.0
# A truth gap is longer than this, or than three of its median steps where those are longer.
_TRUTH_GAP = 0.12
_TRUTH_GAP_STEPS = 3


@dataclass(frozen=True)
class AttitudeScore:
    """The errors of one run.

    Attributes
    ----------
    tilt_rms_deg : float
        RMS of the angle between estimated and true down direction, deg; NaN without samples.
    roll_rms_deg, pitch_rms_deg : float
    coverage_3sigma : float
        Share of the scoreable samples, those without attitude among them, whose tilt error is at
        most three predicted sigma.
    nees : float
        Mean normalised squared error of the two tilt components; ideally 2.
    samples : int
        How many samples the RMS values are made of.
    skipped_s : float
        Seconds after the settling time left out for want of truth or of an attitude.
    predicted_tilt_deg : float
        What the filter says ``tilt_rms_deg`` is: RMS of the predicted sigma.
    median_sigma_deg : float
        Median of the predicted sigma, the root of the covariance's trace.
    """

    tilt_rms_deg: float
    roll_rms_deg: float
    pitch_rms_deg: float
    coverage_3sigma: float
    nees: float
    samples: int
    skipped_s: float
    predicted_tilt_deg: float
    median_sigma_deg: float


def score_attitude(stamp_ns, q_nb_wxyz, tilt_covariance_n, valid, truth, settle=_SETTLE):
    """Score a run of attitudes against the truth.

    Parameters
    ----------
    stamp_ns : (N,) int64, not decreasing
    q_nb_wxyz : (N, 4) float64
        Any finite value where ``valid`` is False.
    tilt_covariance_n : (N, 2, 2) float64, rad^2, or None
        Covariance of the small rotation about the north and east axes of the estimate's own
        navigation frame. None, for estimators without one, makes its figures NaN.
    valid : (N,) bool
        False where the filter says that it has no attitude yet.
    truth : AttitudeSeries
    settle : float, s
        Left out after the first stamp.

    Raises
    ------
    ValueError
        Array lengths differ, stamps decrease, a covariance is not positive definite, there is no
        truth, or it does not overlap.
    """
    stamp_ns, valid = np.asarray(stamp_ns, dtype=np.int64), np.asarray(valid, dtype=bool)
    q_nb_wxyz = np.asarray(q_nb_wxyz, dtype=float)
    if tilt_covariance_n is None:
        tilt_covariance_n = np.full((len(stamp_ns), 2, 2), np.nan)
    if not len(stamp_ns) == len(q_nb_wxyz) == len(tilt_covariance_n) == len(valid):
        raise ValueError(f"lengths differ: {len(stamp_ns)} stamps, {len(q_nb_wxyz)} attitudes, "
                         f"{len(tilt_covariance_n)} covariances, {len(valid)} validities")
    if len(stamp_ns) == 0:
        raise ValueError("no estimates to score")
    if np.any(np.diff(stamp_ns) < 0):
        raise ValueError("stamp_ns decreases: estimates must be in time order")

    true_down_b, spanned = interpolate_down(truth, stamp_ns)
    settled = (stamp_ns - stamp_ns[0]) * 1e-9 >= settle
    scoreable = spanned & settled
    if not scoreable.any():
        raise ValueError(f"no truth for any of the {np.count_nonzero(settled)} estimates that come "
                         f"{settle} s or more after the first")
    used = scoreable & valid
    step = np.diff(stamp_ns, prepend=stamp_ns[0]) * 1e-9
    since_settled = (stamp_ns - stamp_ns[0]) * 1e-9 - settle
    skipped_s = np.sum(np.minimum(step, since_settled)[settled & ~used])
    covariance = np.asarray(tilt_covariance_n, dtype=float)[used]
    if np.any(covariance[:, 0, 0] * covariance[:, 1, 1] <= covariance[:, 0, 1] ** 2):
        raise ValueError("tilt_covariance_n is not positive definite at a stamp with an attitude")
    return _score(q_nb_wxyz[used], covariance, true_down_b[used], np.count_nonzero(scoreable),
                  float(skipped_s))


def interpolate_down(truth, stamp_ns):
    """Return the true down direction at other stamps.

    Parameters
    ----------
    truth : AttitudeSeries
        Of samples with equal stamps the first counts.
    stamp_ns : (N,) int64

    Returns
    -------
    down_b : (N, 3)
    spanned : (N,) bool
        Whether two truth samples no further apart than max(0.12 s, three median truth steps)
        enclose the stamp; elsewhere ``down_b`` has no meaning.

    Raises
    ------
    ValueError
        There are fewer than two truth stamps.
    """
    true_stamp_ns, first = np.unique([] if truth is None else truth.stamp_ns, return_index=True)
    if len(true_stamp_ns) < 2:
        raise ValueError("no truth: at least two true attitudes with different stamps are needed")
    q = truth.q_nb_wxyz[first]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    gaps = np.diff(true_stamp_ns)
    longest = max(_TRUTH_GAP * 1e9, _TRUTH_GAP_STEPS * np.median(gaps))
    before = np.searchsorted(true_stamp_ns, stamp_ns, side="right") - 1
    before = np.clip(before, 0, len(gaps) - 1)
    fraction = (stamp_ns - true_stamp_ns[before]) / gaps[before]
    inside = (fraction >= 0) & (fraction <= 1)
    spanned = inside & ((gaps[before] <= longest) | (fraction == 0) | (fraction == 1))
    fraction = np.where(inside, fraction, 0.0)
    return down_from_quaternion(quaternion_slerp(q[before], q[before + 1], fraction)), spanned


def tilt_error_n(q_nb_wxyz, true_down_b):
    """Return the error of the estimated tilt as a rotation, (N, 2), rad.

    It is the rotation vector about the north and east axes of the estimate's own navigation frame
    that takes its down axis to the true down direction; its length is the tilt error.

    Parameters
    ----------
    q_nb_wxyz : (N, 4)
    true_down_b : (N, 3), any length
    """
    north, east, down = np.moveaxis(
        np.einsum("nij,nj->ni", dcm_from_quaternion(q_nb_wxyz), true_down_b), -1, 0)
    sine = np.hypot(north, east)
    ratio = np.divide(np.arctan2(sine, down), sine, out=np.ones_like(sine), where=sine > 0)
    return np.stack([-east * ratio, north * ratio], axis=-1)


def _score(q_nb_wxyz, covariance, true_down_b, scoreable, skipped_s):
    error = tilt_error_n(q_nb_wxyz, true_down_b)
    tilt = np.hypot(error[:, 0], error[:, 1])
    sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    true_roll_pitch = roll_pitch_from_down(true_down_b)
    roll_error, pitch_error = (
        np.angle(np.exp(1j * (estimated - true))) for estimated, true in
        zip(roll_pitch_from_down(down_from_quaternion(q_nb_wxyz)), true_roll_pitch, strict=True))
    weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
    unknown = len(sigma) > 0 and np.isnan(sigma).all()
    return AttitudeScore(
        tilt_rms_deg=_rms_deg(tilt),
        roll_rms_deg=_rms_deg(roll_error),
        pitch_rms_deg=_rms_deg(pitch_error),
        coverage_3sigma=np.nan if unknown else np.count_nonzero(tilt <= 3 * sigma) / scoreable,
        nees=_mean(np.sum(error * weighted, axis=-1)),
        samples=len(tilt),
        skipped_s=skipped_s,
        predicted_tilt_deg=_rms_deg(sigma),
        median_sigma_deg=float(np.degrees(np.median(sigma))) if len(sigma) else np.nan)


def _mean(values):
    return float(np.mean(values)) if len(values) else np.nan


def _rms_deg(angles):
    return float(np.degrees(np.sqrt(_mean(angles ** 2))))

"""Compiled kernel: the search for the heading, trial by trial."""

import math

import numpy as np
from numba import njit

# Without nuisances the misfit is a trigonometric polynomial of degree two: four extrema at most.
GRID_POINTS = 72
# Squared normalised misfit by which a second heading must be worse than the best.
MODE_GAP = 16.0
_FAR = 5.0  # standard deviations from the best beyond which another heading is another mode
_FARTHEST = 0.5 * math.pi
_STEPS = 60
_LONGEST_STEP = 2 * math.pi / GRID_POINTS


@njit(cache=True)
def search_heading(in_plane, covariance, scale_var, skew_var, level, level_covariance, latitude, latitude_var,
                   zero_var, out):
    """Search the heading that explains in-plane Earth rates best, trial by trial.

    Parameters
    ----------
    in_plane : (N, C, 2) float64
        X and Y seen by each of C gyros, Earth rates.
    covariance : (C, 2, 2) float64
    scale_var, skew_var : (C,) float64
        Prior variances of each gyro's scale factor error and of its turn about the table's axis.
    level : (N, 2) float64, rad
        Roll and pitch.
    level_covariance : (2, 2) float64
    latitude, latitude_var, zero_var : float
        ``zero_var`` is of the table zero, which all gyros share.
    out : (N, 6) float64
        Filled with heading, its variance, squared normalised misfit, second heading, its misfit, and scale.
    """
    costs = np.empty(GRID_POINTS)
    minima = np.empty(GRID_POINTS)
    for n in range(len(in_plane)):
        known = (in_plane[n], covariance, scale_var, skew_var,
                 math.sin(level[n, 0]), math.cos(level[n, 0]), math.sin(level[n, 1]), math.cos(level[n, 1]),
                 math.sin(latitude), math.cos(latitude), level_covariance[0, 0], level_covariance[0, 1],
                 level_covariance[1, 1], latitude_var, zero_var)
        count = _find_minima(known, costs, minima)
        best, best_cost = 0.0, np.inf
        for i in range(count):
            cost = _fit_at(minima[i], known)[0]
            if cost < best_cost:
                best, best_cost = minima[i], cost
        minima[count] = _refine(_mirror(best, known), known)
        mirror_cost = _fit_at(minima[count], known)[0]
        if mirror_cost < best_cost:
            minima[count], best, best_cost = best, minima[count], mirror_cost
        _, misfit, _, information, scale = _fit_at(best, known)
        second, second_cost = _second_mode(best, information, minima[:count + 1], costs, known)
        out[n, 0] = _wrap(best)
        out[n, 1] = 1 / information if information > 0 else np.inf
        out[n, 2] = misfit
        out[n, 3] = second
        out[n, 4] = second_cost - best_cost
        out[n, 5] = scale


@njit(cache=True)
def _find_minima(known, costs, minima):
    """Fill the cost over the circle and its refined minima; return how many."""
    for i in range(GRID_POINTS):
        costs[i] = _fit_at(i * _LONGEST_STEP, known)[0]
    count = 0
    for i in range(GRID_POINTS):
        if costs[i] <= costs[i - 1] and costs[i] < costs[(i + 1) % GRID_POINTS]:
            minima[count] = _refine(i * _LONGEST_STEP, known)
            count += 1
    return count


@njit(cache=True)
def _second_mode(best, information, minima, costs, known):
    """Return the heading that explains most among those far from the best, and its cost."""
    far = min(_FAR / math.sqrt(information), _FARTHEST) if information > 0 else _FARTHEST
    second, second_cost = np.nan, np.inf
    for i in range(len(minima) + GRID_POINTS):
        heading = minima[i] if i < len(minima) else (i - len(minima)) * _LONGEST_STEP
        if abs(_wrap(heading - best)) > far:
            cost = _fit_at(heading, known)[0] if i < len(minima) else costs[i - len(minima)]
            if cost < second_cost:
                second, second_cost = _wrap(heading), cost
    return second, second_cost


@njit(cache=True)
def _refine(heading, known):
    """Return the nearest minimum of the misfit by damped Gauss-Newton steps."""
    _, misfit, step, information, _ = _fit_at(heading, known)
    for _i in range(_STEPS):
        step = min(max(step, -_LONGEST_STEP), _LONGEST_STEP)
        after = _fit_at(heading + step, known)
        while after[1] > misfit and abs(step) > 1e-14:
            step *= 0.5
            after = _fit_at(heading + step, known)
        if after[1] > misfit:
            break
        heading += step
        settled = abs(step) < 1e-14 or step * step * information < 1e-16
        _, misfit, step, information, _ = after
        if settled:
            break
    return heading


@njit(cache=True)
def _mirror(heading, known):
    """Return the heading on the other side of the fold of the ellipse that (X, Y) goes around.

    Only across a fold, where (X, Y) hardly changes with heading, can two headings look alike.
    """
    covariance, sr, cr, sp, cp = known[1], known[4], known[5], known[6], known[7]
    xx, xy, yy, _ = _inverse(covariance[0, 0, 0], covariance[0, 0, 1], covariance[0, 1, 1])
    # (X, Y) = centre + cos(heading) (cos_x, cos_y) + sin(heading) (0, sin_y), but for cos(latitude).
    cos_x, cos_y, sin_y = cp, sp * sr, -cr
    cos_cos = xx * cos_x * cos_x + 2 * xy * cos_x * cos_y + yy * cos_y * cos_y
    sin_sin = yy * sin_y * sin_y
    cos_sin = xy * cos_x * sin_y + yy * cos_y * sin_y
    return math.atan2(2 * cos_sin, cos_cos - sin_sin) - heading


@njit(cache=True)
def _fit_at(heading, known):
    """Return cost, squared normalised misfit, Gauss-Newton step, information and scale at a heading.

    The cost is -2 log likelihood with every nuisance parameter integrated out to first order.
    """
    (in_plane, covariance, scale_var, skew_var, sr, cr, sp, cp, sl, cl, rr, rp, pp, latitude_var,
     zero_var) = known
    sh, ch = math.sin(heading), math.cos(heading)
    x = ch * cp * cl + sp * sl
    y = (ch * sp * sr - sh * cr) * cl - cp * sr * sl
    z = (ch * sp * cr + sh * sr) * cl - cp * cr * sl
    slope_x, slope_y = -sh * cp * cl, -(sh * sp * sr + ch * cr) * cl

    # Each gyro's own errors widen its covariance; then the gyros' weighted mean.
    w_xx = w_xy = w_yy = v_x = v_y = squares = 0.0
    volume = 1.0
    for c in range(len(in_plane)):
        own_xx = covariance[c, 0, 0] + scale_var[c] * x * x + skew_var[c] * y * y
        own_xy = covariance[c, 0, 1] + (scale_var[c] - skew_var[c]) * x * y
        own_yy = covariance[c, 1, 1] + scale_var[c] * y * y + skew_var[c] * x * x
        i_xx, i_xy, i_yy, det = _inverse(own_xx, own_xy, own_yy)
        m_x, m_y = in_plane[c, 0], in_plane[c, 1]
        w_xx, w_xy, w_yy = w_xx + i_xx, w_xy + i_xy, w_yy + i_yy
        v_x, v_y = v_x + i_xx * m_x + i_xy * m_y, v_y + i_xy * m_x + i_yy * m_y
        # About the prediction, not about zero, so that no digits are lost.
        r_x, r_y = m_x - x, m_y - y
        squares += i_xx * r_x * r_x + 2 * i_xy * r_x * r_y + i_yy * r_y * r_y
        volume *= det
    c_xx, c_xy, c_yy, w_det = _inverse(w_xx, w_xy, w_yy)
    mean_x, mean_y = c_xx * v_x + c_xy * v_y, c_xy * v_x + c_yy * v_y
    r_x, r_y = mean_x - x, mean_y - y
    between = squares - (w_xx * r_x * r_x + 2 * w_xy * r_x * r_y + w_yy * r_y * r_y)

    # What all gyros share: roll, pitch, latitude, table zero.
    pitch_x, pitch_y, roll_y = -(sr * y + cr * z), sr * x, z
    lat_x = sp * cl - ch * cp * sl
    lat_y = -(ch * sp * sr - sh * cr) * sl - cp * sr * cl
    c_xx += pp * pitch_x * pitch_x + latitude_var * lat_x * lat_x + zero_var * y * y
    c_xy += pp * pitch_x * pitch_y + rp * pitch_x * roll_y + latitude_var * lat_x * lat_y - zero_var * x * y
    c_yy += pp * pitch_y * pitch_y + 2 * rp * pitch_y * roll_y + rr * roll_y * roll_y \
        + latitude_var * lat_y * lat_y + zero_var * x * x

    i_xx, i_xy, i_yy, det = _inverse(c_xx, c_xy, c_yy)
    g_x, g_y = i_xx * slope_x + i_xy * slope_y, i_xy * slope_x + i_yy * slope_y
    information = g_x * slope_x + g_y * slope_y
    step = (g_x * r_x + g_y * r_y) / information if information > 0 else 0.0
    misfit = max(between, 0.0) + i_xx * r_x * r_x + 2 * i_xy * r_x * r_y + i_yy * r_y * r_y
    scale = math.hypot(mean_x, mean_y) / max(math.hypot(x, y), 1e-300)
    return misfit + math.log(volume * w_det * det), misfit, step, information, scale


@njit(cache=True)
def _inverse(xx, xy, yy):
    """Return the inverse of a symmetric 2 x 2 matrix, and the determinant."""
    det = xx * yy - xy * xy
    return yy / det, -xy / det, xx / det, det


@njit(cache=True)
def _wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi

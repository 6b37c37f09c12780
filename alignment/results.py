"""Results of levelling and of north finding: estimate, covariance, quality.

Everything is vectorised over leading dimensions ``...`` (Monte-Carlo trials); one solve has none.
"""

import enum
from dataclasses import dataclass, field

import numpy as np

# Horizontal Earth rate, or its sensitivity to heading, in units of the Earth rate: cos(latitude) when level.
SINGULAR_SENSITIVITY = 1e-3
WEAK_SENSITIVITY = 0.17  # cos of 80 deg
LARGEST_SCALE_ERROR = 0.05
# Deviation of a heading, rad, beyond which its first order is none and distant headings do as well.
LARGEST_STD = 0.5


class Quality(enum.Flag):
    """Why a result may not be what it seems; ``Quality(0)`` is a good one."""

    SINGULAR = 1
    """No information in this geometry: the estimate is NaN."""
    WEAK = 2
    """Little information in this geometry; the covariance says how little."""
    AMBIGUOUS = 4
    """Another, distant value explains the readings as well."""
    SCALE = 8
    """The readings are more than 5 % larger or smaller than the Earth's: wrong unit, or moving."""
    INCONSISTENT = 16
    """The readings scatter more than their stated noise and priors allow."""
    SHARED_CHANNEL = 32
    """A z channel stood in for the tipped sensor: its bias and scale factor are taken as the x one's."""


UNBELIEVABLE = Quality.SINGULAR | Quality.AMBIGUOUS | Quality.SCALE | Quality.INCONSISTENT


@dataclass(frozen=True)
class LevelResult:
    """Tilt of the table.

    Attributes
    ----------
    roll, pitch : (...) float64, rad
    covariance : (..., 2, 2) float64, rad^2
        Of roll and pitch, first order; zero where no noise was given.
    bias : (...) float64, m/s^2
        Of the accelerometer used; NaN where the method does not find it.
    scale : (...) float64
        Reading per true value of the accelerometer used; NaN where the method does not find it.
    quality : (...) int64
        Values of :class:`Quality`.
    """

    roll: np.ndarray
    pitch: np.ndarray
    covariance: np.ndarray
    bias: np.ndarray
    scale: np.ndarray
    quality: np.ndarray

    @property
    def flags(self):
        """The :class:`Quality` of a single result."""
        return Quality(int(self.quality))


@dataclass(frozen=True)
class HeadingResult:
    """Heading of the table's x axis at table angle zero, clockwise from true north.

    Attributes
    ----------
    heading : (...) float64, rad
        In [-pi, pi]; NaN where SINGULAR.
    variance : (...) float64, rad^2
    branches : (..., B) float64, rad
        Every solution of the equations, the chosen one first; NaN where there are fewer.
    bias : (...) float64, rad/s
        Of the gyro; NaN where the method does not find it.
    scale : (...) float64
        Reading per true value of the gyro; NaN where the method does not find it.
    quality : (...) int64
        Values of :class:`Quality`.
    chi2 : (...) float64
        Squared normalised misfit to the Earth rate, one degree of freedom; NaN for closed forms.
    latitude : (...) float64, rad
        Where the method finds it (azimuth 6), as a cross-check; otherwise NaN.
    scatter : (...) float64
        How many times their stated noise the readings scatter; NaN where that is not judged.
    """

    heading: np.ndarray
    variance: np.ndarray
    branches: np.ndarray
    bias: np.ndarray
    scale: np.ndarray
    quality: np.ndarray
    chi2: np.ndarray = field(default_factory=lambda: np.asarray(np.nan))
    latitude: np.ndarray = field(default_factory=lambda: np.asarray(np.nan))
    scatter: np.ndarray = field(default_factory=lambda: np.asarray(np.nan))

    @property
    def std(self):
        """Standard deviation of the heading, rad."""
        return np.sqrt(self.variance)

    @property
    def flags(self):
        """The :class:`Quality` of a single result."""
        return Quality(int(self.quality))


def wrap_angle(angle):
    """Return the angle in [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def central_jacobian(function, inputs, steps):
    """Return the derivatives of a function's outputs by central differences, (..., m, n).

    Parameters
    ----------
    function : callable
        (..., n) to (..., m).
    inputs : (..., n) float64
    steps : (n,) float64
        Half widths of the differences, in the unit of each input.
    """
    shifts = np.diag(steps).reshape(len(steps), *(1,) * (inputs.ndim - 1), len(steps))
    change = np.moveaxis(function(inputs + shifts) - function(inputs - shifts), 0, -1)
    return change / (2 * np.asarray(steps))


def propagate_covariance(function, inputs, steps, covariance):
    """Return the first-order covariance of a function's outputs, (..., m, m).

    Parameters as of :func:`central_jacobian`; ``covariance`` (..., n, n) is of the inputs.
    """
    jacobian = central_jacobian(function, inputs, steps)
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)

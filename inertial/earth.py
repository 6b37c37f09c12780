"""The Earth as navigation sees it: gravity, rotation rate and radii of the WGS84 ellipsoid.

Latitudes are geodetic, rad; heights are above the ellipsoid, m, up. Everything is vectorised.
Sources: NIMA TR8350.2 (WGS84), 3rd edition, tables 3.1-3.4 and equations 4-1 and 4-3; P. Groves,
Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 2.4.
"""

import numpy as np

STANDARD_GRAVITY = 9.80665
EARTH_RATE = 7.292115e-5
SEMI_MAJOR_AXIS = 6378137.0
FLATTENING = 1.0 / 298.257223563

_ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)
_EQUATOR_GRAVITY = 9.7803253359
_SOMIGLIANA = 0.00193185265241
_RATE_RATIO = 0.00344978650684


def normal_gravity(latitude, height=0.0):
    """Return the magnitude of normal gravity, m/s^2 (TR8350.2 equations 4-1 and 4-3).

    Parameters
    ----------
    latitude : float or array, rad
    height : float or array, m
    """
    sin2 = np.sin(latitude) ** 2
    surface = _EQUATOR_GRAVITY * (1 + _SOMIGLIANA * sin2) / np.sqrt(1 - _ECCENTRICITY2 * sin2)
    ratio = np.asarray(height) / SEMI_MAJOR_AXIS
    return surface * (1 - 2 * (1 + FLATTENING + _RATE_RATIO - 2 * FLATTENING * sin2) * ratio
                      + 3 * ratio ** 2)


def earth_rate_n(latitude):
    """Return the Earth's rotation rate in NED axes, (..., 3), rad/s."""
    latitude = np.asarray(latitude, dtype=float)
    return EARTH_RATE * np.stack([np.cos(latitude), np.zeros_like(latitude), -np.sin(latitude)],
                                 axis=-1)


def radii_of_curvature(latitude):
    """Return the radii of curvature in the meridian and in the prime vertical, m."""
    root2 = 1 - _ECCENTRICITY2 * np.sin(latitude) ** 2
    transverse = SEMI_MAJOR_AXIS / np.sqrt(root2)
    return transverse * (1 - _ECCENTRICITY2) / root2, transverse


def transport_rate_n(latitude, height, velocity_n):
    """Return the rate at which the NED frame turns as it is carried along, (..., 3), rad/s.

    Parameters
    ----------
    latitude : float or array, rad
    height : float or array, m
    velocity_n : (..., 3), m/s
    """
    meridian, transverse = radii_of_curvature(latitude)
    north, east = np.moveaxis(np.asarray(velocity_n, dtype=float)[..., :2], -1, 0)
    east_rate = east / (transverse + height)
    return np.stack([east_rate, -north / (meridian + height), -east_rate * np.tan(latitude)],
                    axis=-1)

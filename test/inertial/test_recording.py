"""Series refuse what compiled code, which checks nothing, would read beyond or take for something else."""

import numpy as np
import pytest

from inertial.recording import AltitudeSeries, ImuSeries

STAMPS = np.arange(1, 5)
VECTORS = np.zeros((4, 3))


def test_lists_singles_and_slices_become_contiguous_doubles():
    imu = ImuSeries([1, 2], [[1, 2, 3], [4, 5, 6]], np.zeros((3, 2), np.float32).T)
    assert imu.stamp_ns.dtype == np.int64
    for values in (imu.gyro_b, imu.accel_b):
        assert values.dtype == np.float64 and values.flags.c_contiguous and values.shape == (2, 3)


def test_nothing_at_all_is_a_series_too():
    assert ImuSeries([], [], []).gyro_b.shape == (0, 3)


def test_what_fits_is_kept_without_a_copy():
    imu = ImuSeries(STAMPS, VECTORS, VECTORS)
    assert imu.stamp_ns is STAMPS and imu.gyro_b is VECTORS


@pytest.mark.parametrize("kind, fields, reason", [
    (ImuSeries, (STAMPS, VECTORS[:2], VECTORS), r"gyro_b has shape \(2, 3\), expected \(4, 3\)"),
    (ImuSeries, (STAMPS, VECTORS, VECTORS[:, :2]), r"accel_b has shape \(4, 2\), expected \(4, 3\)"),
    (ImuSeries, (STAMPS * 0.01, VECTORS, VECTORS), "stamp_ns is float64 of shape .*: must be .* integers, nanoseconds"),
    (AltitudeSeries, (STAMPS, VECTORS, STAMPS), r"altitude has shape \(4, 3\), expected \(4,\)"),
    (AltitudeSeries, (STAMPS, np.zeros(4), STAMPS[:1]), r"arrival has shape \(1,\), expected \(4,\)")])
def test_another_shape_or_type_is_refused_by_name(kind, fields, reason):
    with pytest.raises(ValueError, match=reason):
        kind(*fields)

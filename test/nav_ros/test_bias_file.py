"""A bias file comes back as it was written; a broken one says what is wrong with it."""

import pytest

from nav_ros.bias_file import BiasFileError, StoredBiases, read_biases, write_biases

STORED = StoredBiases(1_700_000_000_123_456_789, (0.01, -0.02, 3e-5), (1e-3, 1e-3, 2e-3), (0.1, 0.0, -0.05),
                      (0.02, 0.03, 0.04))
ROUNDING = 1e-6  # seven digits are written


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "biases.yaml"
    for _ in range(2):  # the second time over the first
        write_biases(path, STORED)
        read = read_biases(path)
        assert read.stamp_ns == STORED.stamp_ns
        for name in ("gyro_bias", "gyro_bias_std", "accel_bias", "accel_bias_std"):
            assert getattr(read, name) == pytest.approx(getattr(STORED, name), rel=ROUNDING)
    assert [file.name for file in tmp_path.iterdir()] == ["biases.yaml"]


def test_no_file_is_no_fault(tmp_path):
    assert read_biases(tmp_path / "none.yaml") is None


@pytest.mark.parametrize("change, reason", [
    (lambda text: "", "no stamp_ns"), (lambda text: "[1, 2", "cannot be read"),
    (lambda text: text[:text.index("accel_bias:")], "accel_bias = None: must be three numbers"),
    (lambda text: text.replace("stamp_ns: 17", "stamp_ns: x17"), "no stamp_ns"),
    (lambda text: text.replace("1.000000e-02", ".nan"), "gyro_bias = .* must be three numbers"),
    (lambda text: text.replace("2.000000e-03", "-2.0e-03"), "gyro_bias_std = .* above 0"),
    (lambda text: text.replace("\n", "\x00"), "cannot be read")])
def test_a_broken_file_says_why_in_one_line(tmp_path, change, reason):
    path = tmp_path / "biases.yaml"
    write_biases(path, STORED)
    path.write_text(change(path.read_text()))
    with pytest.raises(BiasFileError, match=reason) as error:
        read_biases(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_folder_that_is_not_there_is_an_error_of_the_system(tmp_path):
    with pytest.raises(OSError):
        write_biases(tmp_path / "none" / "biases.yaml", STORED)

"""Biases kept from one run to the next: a small YAML file in the axes and units of the messages (FLU, SI)."""

import math
import os
from dataclasses import dataclass
from pathlib import Path

_TEXT = """\
# Biases of an IMU as a node last knew them, in its own axes (FLU). Delete this file after a change of IMU.
stamp_ns: {stamp_ns}
gyro_bias: {gyro_bias}         # rad/s
gyro_bias_std: {gyro_bias_std}     # rad/s
accel_bias: {accel_bias}        # m/s^2
accel_bias_std: {accel_bias_std}    # m/s^2
"""
_VECTORS = ("gyro_bias", "gyro_bias_std", "accel_bias", "accel_bias_std")


class BiasFileError(ValueError):
    """A bias file that cannot be used; the text says why."""


@dataclass(frozen=True)
class StoredBiases:
    """Biases and what they are uncertain by, each a tuple of three, at a stamp."""

    stamp_ns: int
    gyro_bias: tuple
    gyro_bias_std: tuple
    accel_bias: tuple
    accel_bias_std: tuple


def read_biases(path):
    """Return the :class:`StoredBiases` of a file, or None where there is no such file.

    Raises
    ------
    BiasFileError
        It cannot be read, or has not what it should.
    """
    from ruamel.yaml import YAML  # a node's start does not wait for it
    from ruamel.yaml.error import YAMLError
    try:
        content = YAML(typ="safe").load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise BiasFileError(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict) or not isinstance(content.get("stamp_ns"), int):
        raise BiasFileError(f"{path}: no stamp_ns in it")
    return StoredBiases(content["stamp_ns"], *(_vector(path, content, name) for name in _VECTORS))


def write_biases(path, biases):
    """Write a file as a whole or not at all.

    Raises
    ------
    OSError
    """
    text = _TEXT.format(stamp_ns=biases.stamp_ns, **{
        name: "[" + ", ".join(f"{value:.6e}" for value in getattr(biases, name)) + "]" for name in _VECTORS})
    beside = Path(f"{path}.new")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, path)


def _vector(path, content, name):
    values = content.get(name)
    numbers = isinstance(values, list) and len(values) == 3 and all(
        isinstance(value, (int, float)) and math.isfinite(value) for value in values)
    if not numbers or (name.endswith("_std") and min(values) <= 0.0):
        raise BiasFileError(f"{path}: {name} = {values!r}: must be three numbers"
                            + (" above 0" if name.endswith("_std") else ""))
    return tuple(float(value) for value in values)

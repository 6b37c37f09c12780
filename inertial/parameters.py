"""Parameters that describe themselves: default, unit, range and meaning in one place.

A parameter set is a frozen dataclass whose fields are made by :func:`parameter` and which calls
:func:`check_parameters` in ``__post_init__``. Node parameters, the README's table and the error
messages are all made from these fields, so no second list exists.
"""

import dataclasses
import math


def parameter(default, unit, description, minimum=None, maximum=None, *, choices=None,
              nan_means=None, runtime=True):
    """Return a dataclass field with the parameter's description.

    Parameters
    ----------
    default : bool, int, float, str or tuple of float
        Also fixes the type.
    unit : str
        SI unit, ``""`` for a pure number.
    description : str
        Meaning, and what a larger value does.
    minimum, maximum : float, optional
        Inclusive range; for a tuple, of each element.
    choices : tuple of str, optional
        Allowed values of a string.
    nan_means : str, optional
        What NaN stands for; where it is None, NaN is refused.
    runtime : bool
        Whether a running node may change it.
    """
    return dataclasses.field(default=default, metadata={
        "unit": unit, "description": description, "minimum": minimum, "maximum": maximum,
        "choices": choices, "nan_means": nan_means, "runtime": runtime})


_LONG = 8  # characters


def check_parameters(params):
    """Check every field of a parameter dataclass against its type and range.

    Raises
    ------
    ValueError
        Naming the parameter, its value, its unit and what is allowed.
    """
    for field in dataclasses.fields(params):
        value = getattr(params, field.name)
        if isinstance(field.default, tuple):
            if len(value) != len(field.default):
                raise ValueError(f"{field.name} needs {len(field.default)} values, "
                                 f"got {len(value)}")
            for element in value:
                _check_value(field, element, field.default[0])
        else:
            _check_value(field, value, field.default)


def _check_value(field, value, default):
    meta = field.metadata
    unit = f" {meta['unit']}" if meta["unit"] else ""
    if isinstance(default, (bool, str)):
        if type(value) is not type(default):
            wanted = "text" if isinstance(default, str) else "true or false"
            raise ValueError(f"{field.name} = {value!r}: must be {wanted}")
        if meta["choices"] and value not in meta["choices"]:
            raise ValueError(f"{field.name} = {value!r}: must be one of "
                             f"{', '.join(meta['choices'])}")
        return
    if isinstance(value, (bool, str)) or not isinstance(value, (int, float)):
        hint = "; YAML writes .nan" if str(value).lower() == "nan" else ""
        raise ValueError(f"{field.name} = {value!r}: must be a number{unit and ' in' + unit}{hint}")
    if math.isnan(value):
        if meta["nan_means"] is None:
            raise ValueError(f"{field.name} = nan: must be a number{unit and ' in' + unit}")
        return
    low = -math.inf if meta["minimum"] is None else meta["minimum"]
    high = math.inf if meta["maximum"] is None else meta["maximum"]
    if not math.isfinite(value) or not low <= value <= high:
        in_degrees = meta["unit"] == "rad" and math.isfinite(value) and low <= math.radians(value) <= high
        hint = f"; {value:g} deg are {math.radians(value):.6g} rad" if in_degrees else ""
        raise ValueError(f"{field.name} = {value}{unit}: must be from {_short(low)} to {_short(high)}{unit}{hint}")


def _short(number):
    """Return a number's text, without the many digits of a fraction of pi."""
    return f"{number}" if len(f"{number}") <= _LONG else f"{number:.6g}"

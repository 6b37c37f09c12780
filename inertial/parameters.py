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
        Naming each parameter that is wrong, its value, its unit and what is allowed.
    """
    faults = [fault for field in dataclasses.fields(params) if (fault := _fault(field, getattr(params, field.name)))]
    if faults:
        raise ValueError("; ".join(faults))


def _fault(field, value):
    """Return what is wrong with a field's value, empty where nothing is."""
    if not isinstance(field.default, tuple):
        return _value_fault(field, value, field.default)
    if isinstance(value, (str, bytes)) or not hasattr(value, "__len__"):
        return f"{field.name} = {value!r}: must be {len(field.default)} values"
    if len(value) != len(field.default):
        return f"{field.name} needs {len(field.default)} values, got {len(value)}"
    return next(filter(None, (_value_fault(field, element, field.default[0]) for element in value)), "")


def _value_fault(field, value, default):
    meta = field.metadata
    unit = f" {meta['unit']}" if meta["unit"] else ""
    if isinstance(default, (bool, str)):
        if type(value) is not type(default):
            return f"{field.name} = {value!r}: must be {'text' if isinstance(default, str) else 'true or false'}"
        if meta["choices"] and value not in meta["choices"]:
            return f"{field.name} = {value!r}: must be one of {', '.join(meta['choices'])}"
        return ""
    if isinstance(value, (bool, str)) or not isinstance(value, (int, float)):
        hint = "; YAML writes .nan" if str(value).lower() == "nan" else ""
        return f"{field.name} = {value!r}: must be a number{unit and ' in' + unit}{hint}"
    if math.isnan(value):
        return f"{field.name} = nan: must be a number{unit and ' in' + unit}" if meta["nan_means"] is None else ""
    low = -math.inf if meta["minimum"] is None else meta["minimum"]
    high = math.inf if meta["maximum"] is None else meta["maximum"]
    if math.isfinite(value) and low <= value <= high:
        return ""
    in_degrees = meta["unit"] == "rad" and math.isfinite(value) and low <= math.radians(value) <= high
    hint = f"; {value:g} deg are {math.radians(value):.6g} rad" if in_degrees else ""
    return f"{field.name} = {value}{unit}: must be from {_short(low)} to {_short(high)}{unit}{hint}"


def _short(number):
    """Return a number's text, without the many digits of a fraction of pi."""
    return f"{number}" if len(f"{number}") <= _LONG else f"{number:.6g}"

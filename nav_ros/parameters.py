"""Node parameters made from the dataclasses that describe them, and read from files for the offline tools.

Names, defaults, units, ranges and meanings live only in the dataclass (:mod:`inertial.parameters`). A value
that the dataclass refuses never reaches the node: at the start it ends the start with the reason, later the
old value is kept and the caller gets the reason.
"""

import dataclasses
import difflib
import math
import textwrap
from pathlib import Path

# ROS gives these to every node, so they may stand in a file that an offline tool reads.
_ROS_OWN = ("use_sim_time", "qos_overrides", "start_type_description_service")


def declare_parameters(node, params_class, prefix=""):
    """Declare every field of a parameter dataclass on a node; warn of names that were given and are no field.

    Parameters
    ----------
    node : rclpy.node.Node
    params_class : type
        Its fields are made by :func:`inertial.parameters.parameter`.
    prefix : str
        Put before each name, for example ``"gate."``.

    Returns
    -------
    instance of `params_class`
        With the values given on the command line or in a file.

    Raises
    ------
    ValueError
        Naming the parameter, the value and what is allowed.
    """
    from rcl_interfaces.msg import ParameterDescriptor
    known = parameter_names(params_class, prefix)
    given = [name for name in node._parameter_overrides if name.startswith(prefix)]
    for fault in unknown_parameters(given, known):  # what nobody declares rclpy drops without a word
        node.get_logger().warning(fault)
    values = {}
    for field in dataclasses.fields(params_class):
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        # Dynamic, so that a 1 will do for 1.0; the dataclass checks the type.
        descriptor = ParameterDescriptor(dynamic_typing=True)
        declared = node.declare_parameter(prefix + field.name, default, descriptor)
        values[field.name] = _converted(field, declared.value)
    params = params_class(**values)
    for field in dataclasses.fields(params_class):
        node.set_descriptor(prefix + field.name, _descriptor(field))
    return params


def on_change(node, params, callback, prefix="", check=None):
    """Hand a new parameter instance to `callback` whenever declared parameters are changed.

    Parameters
    ----------
    node : rclpy.node.Node
    params : instance
        As :func:`declare_parameters` returned it.
    callback : callable
        Called with the new instance once it is accepted; must not raise.
    prefix : str
    check : callable, optional
        Called with a proposed instance; a ValueError refuses it with its text as the reason.
    """
    from rcl_interfaces.msg import SetParametersResult
    fields = {prefix + field.name: field for field in dataclasses.fields(params)}
    current = params

    def changed(parameters):
        changes = {fields[parameter.name].name: _converted(fields[parameter.name], parameter.value)
                   for parameter in parameters if parameter.name in fields}
        return dataclasses.replace(current, **changes) if changes else current

    def accept(parameters):
        try:
            proposed = changed(parameters)
            if check is not None and proposed is not current:
                check(proposed)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def apply(parameters):
        nonlocal current
        proposed = changed(parameters)
        if proposed is not current:
            current = proposed
            callback(current)

    node.add_on_set_parameters_callback(accept)
    node.add_post_set_parameters_callback(apply)


def params_from_values(params_class, values, prefix=""):
    """Return an instance with the values given under `prefix`, defaults for the others.

    Parameters
    ----------
    params_class : type
    values : dict
        As :func:`load_parameter_file` returns it; names without the prefix are left to others.
    prefix : str

    Raises
    ------
    ValueError
        From the dataclass.
    """
    return params_class(**{field.name: _converted(field, values[prefix + field.name])
                           for field in dataclasses.fields(params_class) if prefix + field.name in values})


def parameter_names(params_class, prefix=""):
    """Return the parameter names of a dataclass under a prefix."""
    return [prefix + field.name for field in dataclasses.fields(params_class)]


def load_parameter_file(path, node_name, known):
    """Return the parameters that a ROS 2 parameter file gives a node.

    Parameters
    ----------
    path : path-like
        YAML: nodes (``/**``, ``node``, ``/namespace/node``) with ``ros__parameters``, or a plain mapping.
    node_name : str
    known : iterable of str
        Names that exist, see :func:`parameter_names`.

    Returns
    -------
    dict
        Name -> value.

    Raises
    ------
    ValueError
        The file cannot be read, is no mapping, has nothing for the node, or unknown names (the nearest known ones
        are told).
    """
    from ruamel.yaml import YAML  # a node's start does not wait for it
    from ruamel.yaml.error import YAMLError
    try:
        content = YAML(typ="safe").load(Path(path).read_text())
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping of parameter names to values")
    values = {}
    for section in _sections(path, content, node_name):
        values |= _flat(section)
    known = list(known)
    if faults := unknown_parameters(values, known):
        raise ValueError(f"{path}: {' '.join(faults)}")
    return {name: value for name, value in values.items() if name in known}


def unknown_parameters(names, known):
    """Return a text for each of some names that does not exist, with the nearest that does; ROS' own are left out."""
    texts = []
    for name in names:
        if name not in known and name.split(".")[0] not in _ROS_OWN:
            near = difflib.get_close_matches(name, known, 1, 0.0)
            texts.append(f"there is no parameter {name}" + "".join(f"; did you mean {other}?" for other in near))
    return texts


def parameter_table(params_class, prefix=""):
    """Return the rows of a markdown table: name, default, unit, range, meaning."""
    rows = ["| parameter | default | unit | range | meaning |", "|---|---|---|---|---|"]
    for field in dataclasses.fields(params_class):
        meta = field.metadata
        description = meta["description"] + ("" if meta["runtime"] else " (at start only)")
        rows.append(f"| `{prefix}{field.name}` | {_text(field.default)} | {meta['unit'] or '-'} | "
                    f"{_range_text(meta)} | {description} |")
    return rows


def node_help(program, text, params_class):
    """Return what a node prints when it is asked for ``--help``.

    Parameters
    ----------
    program : str
    text : str
        What it does.
    params_class : type
    """
    lines = [f"usage: {program} [--ros-args [-p PARAMETER:=VALUE] [-r TOPIC:=OTHER] [--params-file FILE]]", "",
             text.strip(), "", "parameters:"]
    for field in dataclasses.fields(params_class):
        meta = field.metadata
        facts = [f"default {_text(field.default)} {meta['unit'] or ''}".strip(), _range_text(meta)]
        lines += [f"  {field.name} ({'; '.join(filter(None, facts))})",
                  *textwrap.wrap(meta["description"], 110, initial_indent="      ", subsequent_indent="      ")]
    return "\n".join(lines)


def _converted(field, value):
    """Return a value from ROS or YAML as the type of the field's default, where that loses nothing."""
    if isinstance(field.default, tuple):
        if isinstance(value, (str, bytes)) or not hasattr(value, "__len__"):
            return value  # which the dataclass refuses
        return tuple(_number(field.default[0], element) for element in value)
    return _number(field.default, value)


def _number(default, value):
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(default, int) and not isinstance(default, bool) and isinstance(value, float) \
            and value.is_integer():
        return int(value)
    return value


def _descriptor(field):
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
    meta = field.metadata
    unit = f" [{meta['unit']}]" if meta["unit"] else ""
    descriptor = ParameterDescriptor(description=f"{meta['description']}{unit}", dynamic_typing=True,
                                     read_only=not meta["runtime"], additional_constraints=_range_text(meta))
    # rclpy holds NaN to be outside of every range, so a parameter that may be NaN has only the text.
    bounded = meta["minimum"] is not None and meta["maximum"] is not None and meta["nan_means"] is None
    if bounded and type(field.default) is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(meta["minimum"]),
                                                              to_value=float(meta["maximum"]))]
    elif bounded and type(field.default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(meta["minimum"]),
                                                 to_value=int(meta["maximum"]), step=1)]
    return descriptor


def _range_text(meta):
    if meta["choices"]:
        return ", ".join(meta["choices"])
    low, high = meta["minimum"], meta["maximum"]
    parts = []
    if low is not None and high is not None:
        parts.append(f"{low:g} to {high:g}")
    elif low is not None:
        parts.append(f"from {low:g}")
    elif high is not None:
        parts.append(f"to {high:g}")
    if meta["nan_means"]:
        parts.append(f".nan: {meta['nan_means']}")
    return "; ".join(parts)


def _text(value):
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(_text(element) for element in value)}]"
    if isinstance(value, str):
        return value or '""'
    return ".nan" if isinstance(value, float) and math.isnan(value) else f"{value:g}"


def _sections(path, content, node_name):
    sections = [(name, section["ros__parameters"]) for name, section in content.items()
                if isinstance(section, dict) and "ros__parameters" in section]
    if not sections:
        return [content]
    wild = [section for name, section in sections if name in ("/**", "/*")]
    own = [section for name, section in sections if str(name).rsplit("/", 1)[-1] == node_name]
    if not wild + own:
        there = ", ".join(str(name) for name, _ in sections)
        raise ValueError(f"{path}: nothing for {node_name} in it, only for {there}")
    for section in wild + own:
        if not isinstance(section, dict | None):
            raise ValueError(f"{path}: ros__parameters = {section!r}: expected parameter names and values")
    return [section for section in wild + own if section]


def _flat(section, prefix=""):
    values = {}
    for name, value in section.items():
        if isinstance(value, dict):
            values |= _flat(value, f"{prefix}{name}.")
        else:
            values[f"{prefix}{name}"] = value
    return values

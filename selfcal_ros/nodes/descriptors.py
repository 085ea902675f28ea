# SPDX-License-Identifier: Apache-2.0
"""ROS descriptors of parameters: description, unit, bounds, choices."""

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from selfcal_ros.collection.settings.parameter import Parameter


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the descriptor of a parameter, read-only while the node runs."""
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    told = ParameterDescriptor(description=parameter.description + unit, read_only=True)
    if parameter.choices:
        told.additional_constraints = "one of " + ", ".join(parameter.choices)
    low, high = parameter.low, parameter.high
    if low is None or high is None:
        return told
    if isinstance(parameter.default, float):
        told.floating_point_range = [FloatingPointRange(
            from_value=float(low), to_value=float(high))]
    else:
        told.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return told

# SPDX-License-Identifier: Apache-2.0
"""A parameter of a node, and dataclasses whose fields are parameters.

A field is declared once, with its type, default, unit, bounds and description: the source of the
ROS declarations, of the keys allowed in a file and of the documentation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

from selfcal_ros.errors import InputError, known_are, mend_of

BARE_Y = "y"
"""ROS reads a bare y in a parameter file as true, and `ros2 param dump` writes it bare."""

TYPED = "--"
"""Place of values that were typed as options of a command: what begins these."""
_OPTION_OF = {
    "measurement_sense": "sense",
    "misalignment_model": "misalignment",
    "model_terms": "model",
    "reference_certificate": "certificate",
    "reference_error": "reference",
    "reference_kind": "reference",
    "reference_marks": "reference",
    "reference_u": "reference",
}
"""Parameter -> the option that sets it, where that has another name."""

ROS_OWN = ("use_sim_time", "start_type_description_service")
"""Parameters that every node of rclpy has."""


def place_of(where: str, *names: str) -> str:
    """Return the place of parameters for messages: their options if typed, else their keys."""
    if not where.endswith(TYPED):
        return f"{where}: {' and '.join(names)}"
    options = (_OPTION_OF.get(name, name).replace("_", "-") for name in names)
    return where + f" and {TYPED}".join(options)


@dataclass(frozen=True)
class Parameter:
    """One parameter: its type is the type of its default."""

    name: str
    default: Any
    description: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    def check(self, value: Any, where: str) -> Any:
        """Return `value` as the parameter's type, or raise InputError."""
        kind = type(self.default)
        place = place_of(where, self.name)
        if value is True and self.default == BARE_Y:
            value = BARE_Y
        if kind is list and isinstance(value, str | tuple):
            value = [value] if isinstance(value, str) else list(value)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise InputError(
                place,
                f"{value!r} is not of type {kind.__name__}",
                "put it in quotes" if kind is str else mend_of(value, kind),
            )
        if kind is list and not all(isinstance(item, str) for item in value):
            raise InputError(
                place,
                f"{value!r} is not a list of strings",
                "put each item in quotes",
            )
        if self.choices and value not in self.choices:
            raise InputError(
                place,
                f"{value!r} is not known",
                f"choose one of {', '.join(self.choices)}",
            )
        if kind in (int, float) and not (
            (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
        ):
            raise InputError(
                place,
                (
                    f"{value} is below {self.low} {self.unit}"
                    if self.high is None
                    else f"{value} is outside {self.low} to {self.high} {self.unit}"
                ).rstrip(),
                "correct the value",
            )
        return value + 0.0 if kind is float else value  # -0.0 is 0


def declared(
    default: Any,
    description: str,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    *,
    choices: tuple[str, ...] = (),
) -> Any:
    """Return a field of a dataclass of settings, see `Parameter`."""
    about = {
        "description": description,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
    }
    if isinstance(default, list):
        return field(default_factory=default.copy, metadata=about)
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class Settings:
    """The parameters of a node with their values.

    Attributes
    ----------
    NODE : str
        Name of the node.
    """

    NODE: ClassVar[str]
    hardware_id: str = declared(
        "",
        "name or serial number of the stage, in the health; empty = the namespace, or 'stage'",
    )

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return the parameters, those shared by all nodes last."""
        of_node = [item for item in fields(cls) if item.name in cls.__annotations__]
        shared = [item for item in fields(cls) if item.name not in cls.__annotations__]
        defaults = cls()
        return tuple(
            Parameter(item.name, getattr(defaults, item.name), **item.metadata)
            for item in (*of_node, *shared)
        )

    @classmethod
    def checked(cls, overrides: Mapping[str, Any], where: str) -> Self:
        """Return the settings: each the default or the checked override.

        Raises
        ------
        InputError
            For an unknown name, a wrong type or a value out of bounds.
        """
        table = {parameter.name: parameter for parameter in cls.parameters()}
        values = {}
        for name, value in overrides.items():
            if name in ROS_OWN or name.startswith("qos_overrides."):
                continue
            if name not in table:
                raise InputError(
                    f"{where}: {name}",
                    f"{cls.NODE} has no such parameter",
                    known_are(name, table),
                )
            values[name] = table[name].check(value, where)
        return cls(**values)


@dataclass(frozen=True)
class ManagedSettings(Settings):
    """The parameters of a managed node."""

    autostart: bool = declared(
        True,
        "configure and activate automatically; false = wait for a lifecycle manager",
    )

# SPDX-License-Identifier: Apache-2.0
"""ROS parameter files: what they set of a node."""

from typing import Any

from selfcal_ros.collection.settings.nodes import NODE_PARAMETERS
from selfcal_ros.errors import InputError, known_are


def overrides_in(data: object, node: str, where: str) -> dict[str, Any]:
    """Return what a parsed ROS parameter file sets for `node`, nested names joined by dots.

    Sections count if they are ``/**``, ``**``, the node's name, or end with ``/`` + its name;
    a section of a node that this package does not have is an error.
    """
    found: dict[str, Any] = {}
    for name, section in _sections(data, "", where):
        last = name.rsplit("/", 1)[-1]
        if last not in ("**", "*") and last not in NODE_PARAMETERS:
            raise InputError(f"{where}: {name}", "no node of this package",
                             known_are(last, NODE_PARAMETERS))
        if last == node or last in ("**", "*"):
            flat = dict(_flatten(section, ""))
            if last != node:  # a wild-card section may hold parameters of other nodes
                known = {parameter.name for parameter in NODE_PARAMETERS[node]}
                everywhere = {p.name for table in NODE_PARAMETERS.values() for p in table}
                flat = {key: value for key, value in flat.items()
                        if key in known or key not in everywhere}
            found |= flat
    return found


def _sections(data: object, prefix: str, where: str) -> list[tuple[str, dict]]:
    if not isinstance(data, dict):
        raise InputError(where, "not a ROS parameter file", "write 'NODE: ros__parameters: ...'")
    out = []
    for key, value in data.items():
        if key == "ros__parameters":
            if not isinstance(value, dict | None):
                raise InputError(f"{where}: {prefix}", "ros__parameters is not a mapping",
                                 "write 'name: value' lines below it")
            out.append((prefix, value or {}))
        else:
            out += _sections(value, f"{prefix}/{key}".replace("//", "/"), where)
    return out


def _flatten(section: dict, prefix: str) -> list[tuple[str, Any]]:
    out = []
    for key, value in section.items():
        name = f"{prefix}{key}"
        out += _flatten(value, name + ".") if isinstance(value, dict) else [(name, value)]
    return out

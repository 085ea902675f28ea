# SPDX-License-Identifier: Apache-2.0
"""Messages of rosbags from the fields that `selfcal_ros.messages.from_model` gives."""

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from selfcal_ros.messages.from_model import Fields


def build(store: Typestore, typename: str, fields: Fields) -> object:
    """Return a rosbags message of type `typename` with these fields.

    Raises
    ------
    KeyError
        If a field of the type is not given.
    """
    values: dict[str, Any] = {}
    for name, (kind, argument) in store.fielddefs[typename][1]:
        value = fields[name]
        if isinstance(argument, str):  # a type of its own
            values[name] = build(store, argument, value)
        elif kind == Nodetype.BASE:
            values[name] = value
        else:
            element = argument[0]
            if element[0] == Nodetype.BASE and element[1][0] != "string":
                values[name] = np.array(value, dtype=element[1][0])
            else:
                values[name] = list(value)
    return store.types[typename](**values)

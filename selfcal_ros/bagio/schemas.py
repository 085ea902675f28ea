# SPDX-License-Identifier: Apache-2.0
"""Message definitions without ROS: the contract's own, and those that a bag brings along."""

from functools import cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from selfcal_ros.errors import InputError, first_line

OWN = "selfcal_msgs"


def _message_folder() -> Path:
    """Return the folder of the .msg files: installed beside the code, or in the source tree."""
    source = Path(__file__).parents[2] / "msg_defs" / "msg"
    return source if source.is_dir() else Path(__file__).parents[1] / "msg_text"


@cache
def typestore() -> Typestore:
    """Return ROS 2 Jazzy's common types and this package's messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict = {}
    for file in sorted(_message_folder().iterdir(), key=lambda item: item.name):
        if file.name.endswith(".msg"):
            name = file.name.removesuffix(".msg")
            types.update(get_types_from_msg(file.read_text(), f"{OWN}/msg/{name}"))
    store.register(types)
    return store


def store_of_schema(name: str, encoding: str, text: str, where: str) -> Typestore:
    """Return a typestore that decodes messages as the bag's own schema describes them.

    Parameters
    ----------
    name : str
        Type, like ``selfcal_msgs/msg/ViewCommand``.
    encoding : str
        ``ros2msg`` or ``ros2idl``.
    text : str
        The schema; empty = the bag has none, and the type as known here is used.
    where : str
        Bag and topic, for messages.

    Raises
    ------
    InputError
        If the schema cannot be parsed, or is missing and the type not known.
    """
    if not text.strip():
        if name not in typestore().fielddefs:
            raise InputError(where, f"the bag holds no definition of {name}",
                             "record it with message definitions")
        return typestore()
    try:
        parse = get_types_from_idl if encoding == "ros2idl" else get_types_from_msg
        types = parse(text) if encoding == "ros2idl" else parse(text, name)
        store = get_typestore(Stores.EMPTY)
        for known in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"):
            types.setdefault(known, typestore().fielddefs[known])
        store.register(types)
    except Exception as error:
        raise InputError(where, f"the definition of {name} cannot be read ({first_line(error)})",
                         "record the bag anew") from error
    return store

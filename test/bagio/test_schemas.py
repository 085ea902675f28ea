# SPDX-License-Identifier: Apache-2.0
"""Which definitions of a type have the fields of the one known here, and no others."""

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from selfcal_ros.bagio.schemas import same_layout, typestore

HEADER = "std_msgs/msg/Header"
JOINTS = "sensor_msgs/msg/JointState"
KNOWN = "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n" \
        "float64[] effort\n"


def store_of(joints, header="builtin_interfaces/Time stamp\nstring frame_id\n"):
    store = get_typestore(Stores.EMPTY)
    store.register({**get_types_from_msg(joints, JOINTS), **get_types_from_msg(header, HEADER),
                    "builtin_interfaces/msg/Time": typestore().fielddefs[
                        "builtin_interfaces/msg/Time"]})
    return store


@pytest.mark.parametrize(("joints", "same"), [
    (KNOWN, True), ("int32 MOST=3\n" + KNOWN, True), (KNOWN + "float64 more\n", False),
    (KNOWN.replace("effort", "torque"), False),
    (KNOWN.replace("float64[] e", "float32[] e"), False),
    (KNOWN.replace("string[] name\nfloat64[] position", "float64[] position\nstring[] name"),
     False)])
def test_fields_and_their_order_decide_and_constants_do_not(joints, same):
    assert same_layout(store_of(joints), JOINTS) is same


def test_fields_of_inner_types_count():
    older = "uint32 seq\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    assert same_layout(store_of(KNOWN, older), JOINTS) is False

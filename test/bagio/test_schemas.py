# SPDX-License-Identifier: Apache-2.0
"""Which definitions of a type have the fields of the one known here, and no others."""

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from selfcal_ros.bagio.schemas import (
    COMMON,
    definition_of,
    hash_of,
    same_layout,
    shorter_stores,
    store_of_schema,
    typestore,
)
from selfcal_ros.errors import InputError

HEADER = "std_msgs/msg/Header"
JOINTS = "sensor_msgs/msg/JointState"
KNOWN = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    "float64[] effort\n"
)


def store_of(joints, header="builtin_interfaces/Time stamp\nstring frame_id\n"):
    store = get_typestore(Stores.EMPTY)
    store.register(
        {
            **get_types_from_msg(joints, JOINTS),
            **get_types_from_msg(header, HEADER),
            "builtin_interfaces/msg/Time": typestore().fielddefs[
                "builtin_interfaces/msg/Time"
            ],
        }
    )
    return store


@pytest.mark.parametrize(
    ("joints", "same"),
    [
        (KNOWN, True),
        ("int32 MOST=3\n" + KNOWN, True),
        (KNOWN + "float64 more\n", False),
        (KNOWN.replace("effort", "torque"), False),
        (KNOWN.replace("float64[] e", "float32[] e"), False),
        (
            KNOWN.replace(
                "string[] name\nfloat64[] position", "float64[] position\nstring[] name"
            ),
            False,
        ),
    ],
)
def test_fields_and_their_order_decide_and_constants_do_not(joints, same):
    assert same_layout(store_of(joints), JOINTS) is same


def test_fields_of_inner_types_count():
    older = "uint32 seq\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    assert same_layout(store_of(KNOWN, older), JOINTS) is False


def test_a_schema_is_read_anew_where_any_of_it_differs_and_refused_wherever_it_stands():
    text = "std_msgs/Header header\nfloat64 a\n"
    store = store_of_schema("pkg/msg/T", "ros2msg", text, "bag 1")
    assert store_of_schema("pkg/msg/T", "ros2msg", text, "bag 2") is store
    for name, other in (("pkg/msg/T", text.replace("64", "32")), ("pkg/msg/U", text)):
        found = store_of_schema(name, "ros2msg", other, "bag 1")
        assert found.fielddefs[name][1][1][1][1][0] == (
            "float32" if "32" in other else "float64"
        )
        assert (name in store.fielddefs) == (name == "pkg/msg/T")
    for where in ("bag 1", "bag 2"):
        with pytest.raises(
            InputError,
            match=rf"^{where}: the definition of pkg/msg/T cannot be "
            r"read \(.+\); record the bag again$",
        ):
            store_of_schema("pkg/msg/T", "ros2msg", "float64", where)


@pytest.mark.parametrize("name", [*COMMON, "std_msgs/msg/Float64"])
def test_common_types_are_those_of_jazzy(name):
    """Those that are written out here, and one that is looked up among all of them."""
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    assert definition_of("t", name) == jazzy.generate_msgdef(name, ros_version=2)[0]
    assert hash_of(name) == jazzy.hash_rihs01(name)
    found = store_of_schema(name, "", "", "bag")
    assert found.fielddefs[name] == jazzy.fielddefs[name]
    assert (found is typestore()) == (name in COMMON)


def test_a_type_that_nobody_knows_is_refused():
    with pytest.raises(
        InputError,
        match=r"^bag: the bag has no definition of a/msg/B; record it "
        r"with message definitions$",
    ):
        store_of_schema("a/msg/B", "", "", "bag")
    with pytest.raises(
        InputError,
        match=r"^topic t: no definition of a/msg/B; record only topics "
        r"of known types$",
    ):
        definition_of("t", "a/msg/B")


def test_shorter_stores_hold_as_many_fields_as_their_publisher_knew():
    name, last = "selfcal_msgs/msg/ViewCommand", "plan_id"
    every = [field for field, _ in typestore().fielddefs[name][1]]
    kept = [
        [field for field, _ in store.fielddefs[name][1]]
        for store in shorter_stores(name, last)
    ]
    assert kept == [
        every[:count] for count in range(len(every) - 1, every.index(last), -1)
    ]
    assert kept

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.laser.bag import SeriesTopics, read_series
from selfcal_ros.applications.laser.zigzag import Recording
from selfcal_ros.errors import InputError, NoDataError
from test.support.laser_bags import EPOCH_NS, write_laser_bag

TOPICS = SeriesTopics("/cell/laser", "cell/axes")
SHORT = Recording(
    np.arange(4) * 10**9 + 5,
    np.array([0.5, 0.25, 0.125, 0.0625]),
    np.arange(3) * 10**9,
    np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]),
)


@pytest.mark.parametrize(
    "laser",
    ["std_msgs/msg/Float64", "sensor_msgs/msg/Range", "sensor_msgs/msg/JointState"],
)
@pytest.mark.parametrize(
    "position",
    [
        "sensor_msgs/msg/JointState",
        "geometry_msgs/msg/PointStamped",
        "geometry_msgs/msg/PoseStamped",
    ],
)
@pytest.mark.parametrize("backwards", [False, True])
def test_types_and_order_of_messages_make_no_difference(
    tmp_path, laser, position, backwards
):
    bag = write_laser_bag(
        tmp_path / "b", SHORT, laser=laser, position=position, backwards=backwards
    )
    series, notes = read_series(bag, TOPICS)
    np.testing.assert_array_equal(series.laser_ns - EPOCH_NS, SHORT.laser_ns)
    np.testing.assert_array_equal(series.laser_m, SHORT.laser_m)
    np.testing.assert_array_equal(series.position_ns - EPOCH_NS, SHORT.position_ns)
    np.testing.assert_array_equal(series.position_m, SHORT.position_m)
    assert len(notes) == (laser == "std_msgs/msg/Float64")
    assert not notes or "both clocks must agree" in notes[0]


def test_units_and_joints_are_chosen(tmp_path):
    bag = write_laser_bag(tmp_path / "b", SHORT)
    series, _ = read_series(
        bag, SeriesTopics("cell/laser", "cell/axes", ("y", "theta"), laser_unit_m=1e-3)
    )
    np.testing.assert_allclose(series.laser_m, SHORT.laser_m * 1e-3)
    np.testing.assert_array_equal(series.position_m[:, 0], SHORT.position_m[:, 1])
    np.testing.assert_array_equal(series.position_m[:, 1], 0.5)


def test_a_field_of_another_type_can_be_named(tmp_path):
    bag = write_laser_bag(tmp_path / "b", SHORT, laser="sensor_msgs/msg/Temperature")
    named = SeriesTopics("cell/laser", "cell/axes", laser_field="temperature")
    np.testing.assert_array_equal(read_series(bag, named)[0].laser_m, SHORT.laser_m)


@pytest.mark.parametrize(
    ("topics", "kind", "message"),
    [
        (
            SeriesTopics("none", "cell/axes"),
            NoDataError,
            "topic none: no message of it in the bag; the bag has /cell/laser, /cell/other",
        ),
        (SeriesTopics("cell/laser", "cell/laser"), InputError, "name two topics"),
        (
            SeriesTopics("cell/laser", "cell/axes", ("x", "u")),
            InputError,
            "no joint 'u', only theta, x, y; name the joints",
        ),
        (
            SeriesTopics("cell/laser", "cell/axes", laser_field="header.stamp"),
            InputError,
            "the message has no field 'header.stamp'",
        ),
        (
            SeriesTopics("cell/axes", "cell/laser", laser_field="x"),
            InputError,
            "the type std_msgs/msg/Float64 holds no axis positions; record a JointState",
        ),
    ],
)
def test_what_the_bag_does_not_hold_is_named(tmp_path, topics, kind, message):
    bag = write_laser_bag(tmp_path / "b", SHORT)
    with pytest.raises(kind) as caught:
        read_series(bag, topics)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("", "has no known distance field; name its field with --laser-field"),
        ("header", "the field 'header' is not a number"),
        ("nothing", "has no field 'nothing'"),
    ],
)
def test_a_laser_type_without_a_known_field_is_named(tmp_path, field, message):
    bag = write_laser_bag(tmp_path / "b", SHORT, laser="sensor_msgs/msg/Temperature")
    with pytest.raises(InputError, match=message):
        read_series(bag, SeriesTopics("cell/laser", "cell/axes", laser_field=field))


def test_a_missing_bag_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        read_series(tmp_path / "none.mcap", TOPICS)


def test_a_time_of_logging_beyond_all_clocks_is_named(tmp_path):
    late = Recording(
        SHORT.laser_ns + (2**63 - EPOCH_NS),
        SHORT.laser_m,
        SHORT.position_ns,
        SHORT.position_m,
    )
    bag = write_laser_bag(tmp_path / "b", late, laser="std_msgs/msg/Float64")
    with pytest.raises(InputError, match=r"laser: \d+ ns is not a log time; record"):
        read_series(bag, TOPICS)

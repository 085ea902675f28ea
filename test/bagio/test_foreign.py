# SPDX-License-Identifier: Apache-2.0
"""A bag that somebody else wrote from the contract gives the same map, bit for bit."""

import pytest
import yaml
from rosbags.rosbag2 import Reader

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.parameters import parameter_values
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.api import Options, calibrate
from selfcal_ros.model.result import result_to_dict
from test.support import bags
from test.support.bags import COMPRESSIONS, NO_SUMMARY, Foreign
from test.support.sessions import collected, events_of, small_plan

VALUES = parameter_values("measurement_collector", {}, "test")
EXTRA = "float64 temperature\nstring operator\n"


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan())


@pytest.fixture(scope="module")
def expected(events):
    return result_to_dict(calibrate(collected(events)[1], Options()))


def solved(path, **more):
    measurements, _, lost = collect_bag(path, VALUES, **more)
    return result_to_dict(calibrate(measurements, Options())), lost


def check(path, expected, **more):
    result, lost = solved(path, **more)
    assert result == expected
    assert lost == []


def test_the_reference_is_a_calibration(expected):
    assert expected["observability"]["identifiable"]
    assert expected["rejected"] == {}
    assert max(max(row) for row in expected["error_map"]["gx"]) > 1e-7


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("chunk_size", [1, 700, 1 << 24])
def test_chunks_and_compression(tmp_path, events, expected, compression, chunk_size):
    foreign = Foreign({"chunk_size": chunk_size, "compression": COMPRESSIONS[compression]})
    check(foreign.write(tmp_path / "x.mcap", events), expected)


@pytest.mark.parametrize("options", [
    {"use_chunking": False}, {"use_chunking": False, **NO_SUMMARY}, NO_SUMMARY,
    {"enable_crcs": False}, {"enable_data_crcs": True}, {**NO_SUMMARY, "enable_crcs": False}],
    ids=["no chunks", "no chunks, no summary", "no summary", "no crc", "data crc", "bare"])
@pytest.mark.parametrize("footer", [True, False])
def test_what_mcap_leaves_open(tmp_path, events, expected, options, footer):
    path = Foreign(options, footer=footer).write(tmp_path / "x.mcap", events)
    result, lost = solved(path)
    assert result == expected
    assert len(lost) == (not footer)
    assert footer or "ends without its footer" in lost[0]


def test_fields_at_the_end_are_ignored(tmp_path, events, expected):
    check(Foreign(types=bags.contract_types(EXTRA)).write(tmp_path / "x.mcap", events), expected)


def test_other_topics_are_ignored(tmp_path, events, expected):
    check(Foreign(others=True).write(tmp_path / "x.mcap", events), expected)


def test_order_in_the_file_makes_no_difference(tmp_path, events, expected):
    check(Foreign().write(tmp_path / "x.mcap", bags.shuffled(events)), expected)


def test_a_folder_without_metadata(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "any name.mcap", events)
    check(tmp_path / "bag", expected)


def test_the_writer_of_rosbags(tmp_path, events, expected):
    bag = bags.rosbags_bag(tmp_path / "bag", events)
    check(bag, expected)
    check(next(bag.glob("*.mcap")), expected)
    with Reader(bag) as reader:
        assert reader.message_count == len(events)


@pytest.mark.parametrize("metadata", [True, False])
def test_a_bag_in_many_files_whose_channels_differ(tmp_path, events, expected, metadata):
    parts = bags.split(events, 12)
    for number, part in enumerate(parts):
        Foreign(others=True).write(tmp_path / "bag" / f"part_{number}.mcap", part,
                                   order=number % 4)
    names = [f"part_{number}.mcap" for number in range(len(parts))]
    if metadata:
        (tmp_path / "bag" / "metadata.yaml").write_text(yaml.safe_dump(
            {"rosbag2_bagfile_information": {"relative_file_paths": names}}))
    assert [file.name for file in BagReader(tmp_path / "bag").files] == names
    check(tmp_path / "bag", expected)


def test_a_file_that_metadata_lists_but_nobody_has_is_said(tmp_path, events, expected):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    (tmp_path / "bag" / "metadata.yaml").write_text(yaml.safe_dump(
        {"rosbag2_bagfile_information": {"relative_file_paths": ["a.mcap", "b.mcap"]}}))
    result, lost = solved(tmp_path / "bag")
    assert result == expected
    assert lost == ["the file b.mcap, which metadata.yaml lists, is missing"]


@pytest.mark.parametrize("text", ["", "a: [", "rosbag2_bagfile_information: 5", "[1, 2]",
                                  "rosbag2_bagfile_information: {relative_file_paths: 3}",
                                  "rosbag2_bagfile_information: {relative_file_paths: [3]}"])
def test_damaged_metadata_is_said_and_not_used(tmp_path, events, expected, text):
    Foreign().write(tmp_path / "bag" / "a.mcap", events)
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    result, lost = solved(tmp_path / "bag")
    assert result == expected
    assert lost == ["metadata.yaml is damaged and was not used"]


@pytest.mark.parametrize("namespace", ["/cell1", "/plant/cell1", ""])
def test_a_namespace_in_front_of_the_topics(tmp_path, events, expected, namespace):
    path = Foreign(namespace=namespace).write(tmp_path / "x.mcap", events)
    check(path, expected)
    check(path, expected, namespace=namespace)
    check(path, expected, namespace=namespace.strip("/"))


def test_two_cells_in_one_bag(tmp_path, events, expected):
    other = events_of(small_plan("0, 90, ty"), seed=8)
    for name, content in (("cell1", events), ("cell2", other)):
        Foreign(namespace=f"/{name}").write(tmp_path / "bag" / f"{name}.mcap", content)
    with pytest.raises(InputError, match="topics of two cells, '/cell1' and '/cell2'; "
                       "choose one with --namespace"):
        solved(tmp_path / "bag")
    check(tmp_path / "bag", expected, namespace="cell1")
    result, lost = solved(tmp_path / "bag", namespace="/cell2")
    assert result == result_to_dict(calibrate(collected(other)[1], Options()))
    assert lost == []
    with pytest.raises(NoDataError, match="no topics of the cell 'cell3'; choose one of "
                       "/cell1, /cell2"):
        solved(tmp_path / "bag", namespace="cell3")


def test_without_definitions_the_own_ones_must_fit(tmp_path, events):
    path = Foreign(schemas=False).write(tmp_path / "x.mcap", events)
    with pytest.raises(NoDataError, match=r"no message on selfcal/view_command \(9 messages on "
                       r"selfcal/view_command could not be decoded\)"):
        solved(path)

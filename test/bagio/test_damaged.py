# SPDX-License-Identifier: Apache-2.0
"""Cut and damaged bags: what is there is read, what was lost is said, never a traceback."""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from test.support.bags import COMPRESSIONS, NO_SUMMARY, Foreign
from test.support.sessions import decoded, events_of, small_plan

SOURCE = Path(__file__).parents[2] / "bags" / "hu_exact" / "hu_exact_0.mcap"
DATA = SOURCE.read_bytes()
with SOURCE.open("rb") as _stream:
    TOTAL = sum(1 for _ in make_reader(_stream).iter_messages())


def read(path):
    reader = BagReader(path)
    return sum(1 for _ in decoded(reader)), reader.lost


def test_a_later_cut_never_reads_less_and_every_loss_is_said(tmp_path):
    counts = []
    for size in np.linspace(200, len(DATA) - 40, 24).astype(int):
        file = tmp_path / "cut.mcap"
        file.write_bytes(DATA[:size])
        count, lost = read(file)
        assert len(lost) == 1 and (
            str(size) in lost[0]
            or "no message is lost" in lost[0]
            or "without its footer" in lost[0]
        )
        counts.append(count)
    assert counts == sorted(counts)
    assert counts[0] < TOTAL / 10 and counts[-1] == TOTAL
    assert len(set(counts)) > 3, (
        "the front part of a chunk that was cut off is read as well"
    )


@pytest.mark.parametrize("seed", range(20))
def test_flipped_bytes_end_in_a_result_or_in_one_line(tmp_path, capsys, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(DATA)
    for at in rng.integers(8, len(data), 3):
        data[at] ^= int(rng.integers(1, 256))
    file = tmp_path / "bad.mcap"
    file.write_bytes(data)
    code = main(["solve", str(file), "--quiet"])
    err = capsys.readouterr().err
    assert code in (0, 2, 3, 4, 5)
    assert code == 0 or err.strip()
    assert "Traceback" not in err


def test_a_truncated_bag_gives_the_result_of_what_is_there(tmp_path, capsys):
    file = tmp_path / "cut.mcap"
    file.write_bytes(DATA[: int(len(DATA) * 0.35)])
    assert main(["solve", str(file), "--quiet"]) in (3, 4)
    assert "truncated" in capsys.readouterr().err
    count, lost = read(file)
    assert 0 < count < TOTAL and "were recovered" in lost[0]


@pytest.fixture(scope="module")
def events():
    """The first command and the last, detections and samples: a file of 11 small chunks."""
    found = events_of(small_plan("0", repeats=1))
    return found[:60] + found[-60:]


def records(data):
    """Return (opcode, place, length) of all records of a file."""
    at, out = 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        out.append((opcode, at, length))
        at += 9 + length
    return out


def relength(data, at, change):
    length = struct.unpack_from("<Q", data, at + 1)[0]
    return (
        data[: at + 1] + struct.pack("<Q", (length + change) % 2**64) + data[at + 9 :]
    )


def damaged(folder, data):
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    reader = BagReader(path)
    return [(topic, stamp) for topic, stamp, _ in decoded(reader)], reader.lost


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("options", [{}, NO_SUMMARY], ids=["summary", "no summary"])
def test_a_wrong_length_of_a_chunk_loses_nothing(
    tmp_path, events, compression, options
):
    path = Foreign(
        {"chunk_size": 1500, "compression": COMPRESSIONS[compression], **options}
    ).write(tmp_path / "x.mcap", events)
    data = path.read_bytes()
    whole, lost = damaged(tmp_path, data)
    assert lost == [] and len(whole) == len(events)
    chunks = [at for opcode, at, _ in records(data) if opcode == Opcode.CHUNK]
    assert len(chunks) > 5
    for at in (chunks[0], chunks[3], chunks[-1]):
        for change in (1, -1, 700, -700, 10**6, 2**62, -(10**6)):
            found, lost = damaged(tmp_path, relength(data, at, change))
            assert found == whole, change
            assert len(lost) <= 1 and (lost or change > 0)
            assert not lost or lost[0].startswith(
                f"the file is damaged from byte {at} to "
            )


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("options", [{}, NO_SUMMARY], ids=["summary", "no summary"])
def test_a_destroyed_chunk_costs_its_own_messages_and_no_more(
    tmp_path, events, compression, options
):
    path = Foreign(
        {"chunk_size": 1500, "compression": COMPRESSIONS[compression], **options}
    ).write(tmp_path / "x.mcap", events)
    data = path.read_bytes()
    whole, _ = damaged(tmp_path, data)
    for number in (3, 0) if not options else (3,):  # the first one declares the topics
        chunks = [
            (at, length) for op, at, length in records(data) if op == Opcode.CHUNK
        ]
        (at, length), (behind, _) = chunks[number], chunks[number + 1]
        broken = data[:at] + bytes(9 + length) + data[at + 9 + length :]
        found, lost = damaged(tmp_path, broken)
        missing = len(whole) - len(found)
        assert 0 < missing < 100
        front = next(i for i, item in enumerate(whole) if found[i] != item)
        assert found == whole[:front] + whole[front + missing :]
        assert lost[0].startswith(
            f"the file is damaged from byte {at} to {behind}: 0 messages"
        )
        assert lost[1:] == (
            []
            if options
            else [f"{missing} of {len(whole)} messages of the file are lost"]
        )


@pytest.mark.parametrize("options", [{}, NO_SUMMARY], ids=["summary", "no summary"])
@pytest.mark.parametrize("change", [1, -1, 50, 5000, 2**40])
def test_a_wrong_length_without_chunks_costs_one_message(
    tmp_path, events, options, change
):
    path = Foreign({"use_chunking": False, **options}).write(
        tmp_path / "x.mcap", events
    )
    data = path.read_bytes()
    whole, lost = damaged(tmp_path, data)
    assert lost == [] and len(whole) == len(events)
    places = [at for opcode, at, _ in records(data) if opcode == Opcode.MESSAGE]
    for number in (0, 100, len(places) - 1):
        found, lost = damaged(tmp_path, relength(data, places[number], change))
        # the payload may still decode, with its end missing or more behind it
        assert found in (whole, whole[:number] + whole[number + 1 :])
        assert lost


def test_a_chunk_whose_checksum_fails_is_not_believed_in_part(tmp_path, events):
    path = Foreign({"chunk_size": 1500, "compression": COMPRESSIONS["none"]}).write(
        tmp_path / "x.mcap", events
    )
    data = bytearray(path.read_bytes())
    whole, _ = damaged(tmp_path, data)
    _, at, length = [r for r in records(data) if r[0] == Opcode.CHUNK][3]
    data[at + length] ^= 1
    found, lost = damaged(tmp_path, bytes(relength(bytes(data), at, 2**50)))
    assert len(found) < len(whole) and set(found) < set(whole)
    assert "0 messages there were recovered" in lost[0]
    with pytest.raises(ValueError, match="crc"):
        path.write_bytes(data)
        with path.open("rb") as file:
            list(make_reader(file, validate_crcs=True).iter_messages())


def test_damage_behind_the_last_message_costs_none_and_is_said_as_such(tmp_path):
    """The data section has its end; of what follows, up to the closing magic, a part is gone."""
    file = tmp_path / "x.mcap"
    end = max(at for opcode, at, _ in records(DATA) if opcode == Opcode.DATA_END)
    for cut, line in (
        (
            end + 13 + 5,
            "the end of the file is damaged, after the last message: no message is lost",
        ),
        (
            end,
            "the file ends without its footer, as when a recorder is killed: every "
            "message that was written is read",
        ),
    ):
        file.write_bytes(DATA[:cut])
        assert read(file) == (TOTAL, [line])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ["b_0.db3", "metadata.yaml"],
            "a bag with sqlite3 storage; convert it with `ros2 bag convert -i BAG ",
        ),
        (
            ["notes.txt"],
            "no .mcap file in this folder; give an MCAP file or a rosbag2 folder with MCAP storage",
        ),
        (
            [],
            "no .mcap file in this folder; give an MCAP file or a rosbag2 folder with MCAP storage",
        ),
    ],
)
def test_a_folder_without_mcap_files_is_refused(tmp_path, names, message):
    for name in names:
        (tmp_path / name).write_text("")
    with pytest.raises(InputError) as raised:
        read(tmp_path)
    assert str(raised.value).startswith(f"{tmp_path}: {message}")


def test_an_mcap_file_beside_one_of_sqlite_is_read(tmp_path):
    (tmp_path / "old.db3").write_bytes(b"")
    (tmp_path / "b_0.mcap").write_bytes(DATA)
    assert read(tmp_path)[0] == TOTAL


def test_what_is_no_bag_is_refused(tmp_path):
    for content, message in (
        (b"", "the file is empty"),
        (b"hello world", "not an MCAP file"),
    ):
        file = tmp_path / "x.mcap"
        file.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read(file)


@pytest.mark.parametrize("how", ["columns", "cdr_messages"])
@pytest.mark.parametrize("place", [0, 1])
def test_a_file_of_a_bag_that_is_no_mcap_file_costs_itself(tmp_path, how, place):
    (tmp_path / f"b_{place}.mcap").write_bytes(bytes(5000))
    (tmp_path / f"b_{1 - place}.mcap").write_bytes(DATA)
    reader, whole = BagReader(tmp_path), BagReader(SOURCE)
    assert [topic for topic, *_ in getattr(reader, how)()] == [
        topic for topic, *_ in getattr(whole, how)()
    ]
    assert reader.lost == [f"the file b_{place}.mcap was not read: not an MCAP file"]
    assert reader.topics == whole.topics


def test_a_bag_none_of_whose_files_is_an_mcap_file_is_refused(tmp_path):
    for number, content in enumerate((bytes(100), b"")):
        (tmp_path / f"b_{number}.mcap").write_bytes(content)
    with pytest.raises(
        InputError, match=r"b_0\.mcap: not an MCAP file; give an \.mcap file"
    ):
        read(tmp_path)

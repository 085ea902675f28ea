# SPDX-License-Identifier: Apache-2.0
"""What decompresses to more than it may is refused before it takes the memory or the disk."""

import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from selfcal_ros.bagio import mcap_salvage
from selfcal_ros.bagio.mcap_salvage import (
    FREE,
    RATIO,
    TooLargeError,
    limit_of,
    lz4_chunk,
    memory_left,
    zstd_chunk,
    zstd_message,
)
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.errors import InputError
from test.support.bags import COMPRESSIONS, Foreign
from test.support.sessions import decoded, events_of, small_plan

BIG = 3 * FREE
SMALL_FREE = 4 << 20
PACK = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}
UNPACK = {"zstd": zstd_chunk, "lz4": lz4_chunk}
LOOSE = {
    "zstd": lambda data: zstandard.ZstdCompressor(write_content_size=False).compress(
        data
    ),
    "lz4": lambda data: lz4.frame.compress(data, store_size=False),
}


@pytest.fixture
def tight(monkeypatch):
    """Let the limits be small, so that the bombs can be."""
    monkeypatch.setattr(mcap_salvage, "FREE", SMALL_FREE)
    return SMALL_FREE


@pytest.mark.parametrize("name", PACK)
@pytest.mark.parametrize("pack", [PACK, LOOSE], ids=["told", "not told"])
@pytest.mark.parametrize("size", [0, 1, 100, 70_000, 3_000_000])
def test_what_is_allowed_comes_out_whole(name, pack, size):
    data = np.random.default_rng(size).integers(0, 4, size, dtype=np.uint8).tobytes()
    assert UNPACK[name](pack[name](data), max(size, 1)) == data
    # a length that the file has wrong takes nothing away
    if name == "lz4" or pack is PACK:
        assert UNPACK[name](pack[name](data), size // 2 + 1) == data
        assert UNPACK[name](pack[name](data), 2**62) == data


@pytest.mark.parametrize("name", PACK)
@pytest.mark.parametrize("pack", [PACK, LOOSE], ids=["told", "not told"])
@pytest.mark.parametrize("declared", [0, 1000, 5 * SMALL_FREE])
def test_a_bomb_is_refused_whatever_the_file_declares(tight, name, pack, declared):
    bomb = pack[name](bytes(5 * tight))
    assert len(bomb) * RATIO < 5 * tight
    expected = (TooLargeError, zstandard.ZstdError) if name == "zstd" else TooLargeError
    with pytest.raises(expected):
        UNPACK[name](bomb, declared)


def test_lz4_is_fed_in_blocks(monkeypatch):
    """Each call of its decoder copies what it has not used: 120 MB at once took 42 s."""
    fed = []

    class Decoder(lz4.frame.LZ4FrameDecompressor):
        def decompress(self, data, max_length=-1):
            fed.append(len(data))
            return super().decompress(data, max_length)

    monkeypatch.setattr(mcap_salvage.lz4.frame, "LZ4FrameDecompressor", Decoder)
    data = np.random.default_rng(2).bytes(5 * mcap_salvage.BLOCK + 7)
    packed = LOOSE["lz4"](data)
    assert lz4_chunk(packed, 10) == data
    assert max(fed) == mcap_salvage.BLOCK and sum(fed) == len(packed)


def test_what_is_declared_is_a_limit_beyond_the_free_size(tight):
    data = np.random.default_rng(1).bytes(2 * tight)
    for name, pack in PACK.items():
        assert UNPACK[name](pack(data), len(data)) == data
        with pytest.raises(
            TooLargeError,
            match=r"^it would decompress to 8 MB, more than the 4 MB "
            r"that its size, the file and the memory allow$",
        ):
            UNPACK[name](pack(data), len(data) // 2)


def test_the_limit_follows_size_declaration_and_memory(monkeypatch):
    monkeypatch.setattr(mcap_salvage, "memory_left", lambda: 100 * FREE)
    assert limit_of(10) == FREE
    assert limit_of(FREE) == 25 * FREE
    assert limit_of(FREE // 10) == RATIO * (FREE // 10)
    assert limit_of(FREE // 10, 3 * FREE) == 3 * FREE
    assert limit_of(FREE // 10, 2**63) == RATIO * (FREE // 10)
    assert limit_of(FREE, 5) == FREE


def test_the_memory_that_is_left(monkeypatch, tmp_path):
    page = resource.getpagesize()
    assert 100 * page < memory_left() < 2**50
    monkeypatch.setattr(mcap_salvage, "MEMORY", tmp_path / "meminfo")
    assert 100 * page < memory_left() < 2**50
    mcap_salvage.MEMORY.write_text("MemTotal: 9 kB\nMemAvailable:  1234 kB\n")
    assert memory_left() == 1234 * 1024


@pytest.mark.parametrize("told", [True, False])
def test_a_message_that_would_become_too_large(tight, told):
    squeeze = zstandard.ZstdCompressor(write_content_size=told)
    assert zstd_message(squeeze.compress(b"abc" * 1000)) == b"abc" * 1000
    with pytest.raises(TooLargeError):
        zstd_message(squeeze.compress(bytes(5 * tight)))


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan("0", repeats=1))


def bomb_chunk(name, size):
    """Return a chunk record of `size` zeros, honestly declared."""
    data = bytes(size)
    packed = PACK[name](data)
    body = (
        struct.pack("<QQQII", 0, 0, size, zlib.crc32(data), len(name)) + name.encode()
    )
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


@pytest.mark.parametrize("name", PACK)
def test_a_bomb_in_a_bag_costs_itself_and_one_line(tmp_path, events, tight, name):
    data = (
        Foreign({"compression": COMPRESSIONS["none"]})
        .write(tmp_path / "x.mcap", events)
        .read_bytes()
    )
    at = data.index(bytes([Opcode.DATA_END]) + struct.pack("<Q", 4))
    path = tmp_path / "bomb.mcap"
    path.write_bytes(data[:at] + bomb_chunk(name, 5 * tight) + data[at:])
    reader = BagReader(path)
    assert sum(1 for _ in decoded(reader)) == len(events)
    [line] = reader.lost
    assert line.startswith("the chunk that ends at byte ")
    # LZ4 squeezes zeros 243 times, zstd without end
    limit = {"zstd": 4, "lz4": 17}[name]
    assert line.endswith(
        f" was not read: it would decompress to 21 MB, more than the {limit} MB "
        "that its size, the file and the memory allow"
    )


@pytest.mark.parametrize("name", PACK)
@pytest.mark.parametrize("pack", [PACK, LOOSE], ids=["told", "not told"])
def test_a_bomb_that_is_cut_off_gives_nothing(
    tmp_path, events, tight, name, pack, monkeypatch
):
    monkeypatch.setitem(PACK, name, pack[name])
    data = (
        Foreign({"compression": COMPRESSIONS["none"]})
        .write(tmp_path / "x.mcap", events)
        .read_bytes()
    )
    at = data.index(bytes([Opcode.DATA_END]) + struct.pack("<Q", 4))
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:at] + bomb_chunk(name, 5 * tight)[:-7])
    reader = BagReader(path)
    assert sum(1 for _ in decoded(reader)) == len(events)
    assert "0 messages of the last chunk were recovered" in reader.lost[0]


def test_a_compressed_message_that_is_a_bomb_is_counted(tmp_path, events, tight):
    class Bombs(Foreign):
        def _payload(self, event):
            topic, data = super()._payload(event)
            bomb = topic == "selfcal/view_command"
            return topic, zstandard.compress(bytes(5 * tight) if bomb else data)

    path = Bombs().write(tmp_path / "x.mcap", events)
    for read in (BagReader.columns, BagReader.cdr_messages):
        reader = BagReader(path)
        assert {topic for topic, *_ in read(reader)} == {
            "stage/joint_states",
            "stage/mark_detections",
        }
        n_commands = sum(hasattr(event, "phase") for event in events)
        assert reader.lost == [
            f"{n_commands} messages on /selfcal/view_command were not decompressed: "
            "they would become too large"
        ]


@pytest.mark.parametrize("told", [True, False])
def test_a_file_that_is_a_bomb_is_refused(tmp_path, tight, told):
    path = tmp_path / "x.mcap.zstd"
    path.write_bytes(
        zstandard.ZstdCompressor(write_content_size=told).compress(bytes(5 * tight))
    )
    with pytest.raises(
        InputError,
        match=r"x\.mcap\.zstd: it would decompress to \d+ MB, more than "
        r"the 4 MB that .* allow; if it is a bag, decompress it with zstd -d$",
    ):
        list(decoded(BagReader(path)))


LIMITED = """
import resource, sys
from selfcal_ros.cli.main import main
import selfcal_ros.bagio.offline, selfcal_ros.estimation.api
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (256 << 20),) * 2)
for path in sys.argv[1:]:
    print(main(["solve", path, "--quiet"]))
"""


def test_solve_of_a_bomb_takes_no_memory(tmp_path, events):
    data = Foreign().write(tmp_path / "x.mcap", events).read_bytes()
    paths = [tmp_path / f"{name}.mcap" for name in PACK]
    for path in paths:
        path.write_bytes(data[:8] + bomb_chunk(path.stem, 5 * FREE))
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *map(str, paths)],
        text=True,
        check=False,
        capture_output=True,
        cwd=Path(__file__).parents[2],
    )
    assert done.stdout.split() == ["4", "4"], done.stderr
    assert done.stderr.count("it would decompress to 336 MB") == 2
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("place", ["file", "folder"])
def test_a_bag_of_sqlite_is_told_how_to_become_mcap(tmp_path, place):
    file = tmp_path / "old" / "old_0.db3"
    file.parent.mkdir()
    file.write_bytes(b"SQLite format 3\0" + bytes(100))
    path = file if place == "file" else file.parent
    with pytest.raises(
        InputError,
        match=r"a bag with sqlite3 storage; convert it with `ros2 bag "
        r"convert -i BAG -o OPTIONS\.yaml`",
    ):
        list(decoded(BagReader(path)))

# SPDX-License-Identifier: Apache-2.0
"""``selfcal embed``: files in the bag and out again; the messages stay as they are."""

import contextlib
import json
import os
import shutil
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

from selfcal_ros.bagio import attachments
from selfcal_ros.bagio.attachments import attach, attached
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.results import bag_files, result_bytes
from test.support.pages import ROOT


@pytest.fixture
def bag(tmp_path):
    shutil.copytree(ROOT / "bags/hu_exact", tmp_path / "bag")
    return tmp_path / "bag"


def file_in(bag):
    return next(bag.glob("*.mcap"))


def seen(bag):
    """Return what another reader finds: messages, attachments and their counts."""
    with file_in(bag).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [(m.channel_id, m.log_time, m.data) for _, _, m in reader.iter_messages()]
        files = {a.name: (a.media_type, a.data) for a in reader.iter_attachments()}
        statistics = reader.get_summary().statistics
        assert statistics.attachment_count == len(files)
        assert statistics.message_count == len(messages)
        return messages, files, len(reader.get_summary().chunk_indexes)


def test_files_go_in_and_out_and_the_messages_stay(bag, tmp_path, capsys):
    before = seen(bag)
    result, plan = tmp_path / "r.json", ROOT / "config/plans/hu.yaml"
    assert main(["solve", str(bag), "--quiet", "-o", str(result)]) == 0
    start = file_in(bag).read_bytes()
    assert main(["embed", str(bag)]) == 0
    assert "no attachments" in capsys.readouterr().out
    assert main(["embed", str(bag), str(result), str(plan)]) == 0
    assert capsys.readouterr().out == (f"r.json: {result.stat().st_size} bytes\n"
                                       f"hu.yaml: {plan.stat().st_size} bytes\n")
    messages, files, chunks = seen(bag)
    assert (messages, chunks) == (before[0], before[2])
    assert files == {"r.json": ("application/json", result.read_bytes()),
                     "hu.yaml": ("application/yaml", plan.read_bytes())}
    now = file_in(bag).read_bytes()
    same = next(i for i, (a, b) in enumerate(zip(start, now, strict=False)) if a != b)
    assert same > 0.5 * len(start) and len(now) > len(start)
    table = tmp_path / "t.csv"
    assert main(["table", str(result), "-o", str(table)]) == 0
    assert main(["embed", str(bag), str(table)]) == 0
    kept = ["r.json", "hu.yaml", "t.csv", "t.csv.origin.json"]
    assert set(seen(bag)[1]) == set(kept) == set(attached(bag))
    out = tmp_path / "out"
    out.mkdir()
    capsys.readouterr()
    assert main(["embed", str(bag), "--extract", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [item["name"] for item in said["attachments"]] == kept
    for path in (result, plan, table):
        assert (out / path.name).read_bytes() == path.read_bytes()
    again = tmp_path / "again.json"
    assert main(["solve", str(bag), "--quiet", "-o", str(again)]) == 0
    one, two = (json.loads(path.read_text()) for path in (result, again))
    assert one["error_map"] == two["error_map"] and one["input"] != two["input"]


def test_a_result_of_another_bag_is_refused(bag, tmp_path, capsys):
    other = tmp_path / "other.json"
    assert main(["solve", str(ROOT / "bags/hu_noise"), "--quiet", "-o", str(other)]) == 0
    before = file_in(bag).read_bytes()
    assert main(["embed", str(bag), str(other)]) == 2
    assert "other.json: is not a result of" in capsys.readouterr().err
    assert file_in(bag).read_bytes() == before


def test_a_name_is_taken_once(bag, tmp_path):
    attach(bag, [("a.txt", "text/plain", b"1")], 1)
    before = file_in(bag).read_bytes()
    for items in ([("a.txt", "text/plain", b"2")], [("b", "", b""), ("b", "", b"")]):
        with pytest.raises(InputError, match="is already in the bag"):
            attach(bag, items, 1)
    assert file_in(bag).read_bytes() == before and attached(bag) == {"a.txt": b"1"}


@pytest.mark.parametrize(("spoil", "message"), [
    (lambda raw: raw[:-20], "not an MCAP file with a summary"),
    (lambda raw: raw[:40], "not an MCAP file with a summary"),
    (lambda raw: b"", "not an MCAP file with a summary"),
    (lambda raw: raw.replace(b"kept as it is", b"kept as it was"[:13]), "an attachment is damaged"),
])
def test_a_file_that_was_not_closed_or_is_damaged_is_refused(bag, spoil, message):
    attach(bag, [("a.txt", "text/plain", b"kept as it is")], 1)
    path = file_in(bag)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match=message):
        attached(bag)
    with pytest.raises(InputError, match=message):
        attach(bag, [("b.txt", "text/plain", b"")], 1)


def test_no_damage_of_the_end_is_more_than_one_line(bag):
    attach(bag, [("a.txt", "text/plain", b"content")], 1)
    path = file_in(bag)
    raw = path.read_bytes()
    for back in range(1, 400, 7):
        spoiled = bytearray(raw)
        spoiled[-back] ^= 0xFF
        path.write_bytes(spoiled)
        try:
            assert attached(bag) == {"a.txt": b"content"}
        except InputError as error:
            assert "\n" not in str(error)


def test_files_and_extract_exclude_each_other(bag, capsys):
    assert main(["embed", str(bag), "x.json", "--extract", "."]) == 2
    assert "files are named as well" in capsys.readouterr().err
    assert main(["embed", str(bag / "missing")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def foreign(path, names=(), **how):
    """Write a file with the mcap library alone: 300 messages, metadata, attachments."""
    with path.open("wb") as file:
        writer = Writer(file, **how)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("/t", "json", schema)
        for n in range(300):
            writer.add_message(channel, n, b"%d" % n, n)
        for number, name in enumerate(names):
            writer.add_attachment(1, 1, name, "text/plain", b"%d" % number)
        writer.add_metadata("meta", {"k": "v"})
        writer.finish()
    return path


@pytest.mark.parametrize("how", [
    {"compression": CompressionType.NONE}, {"compression": CompressionType.LZ4},
    {"compression": CompressionType.ZSTD}, {"use_chunking": False}, {"enable_crcs": False},
    {"enable_data_crcs": True}, {"use_summary_offsets": False}, {"chunk_size": 100},
    {"index_types": IndexType.NONE}], ids=str)
def test_files_of_another_writer_are_kept_whole(tmp_path, how):
    """Messages, metadata and attachments, also those that its index does not name."""
    path = foreign(tmp_path / "a.mcap", ["x.txt"], **how)
    before = path.read_bytes()
    attach(path, [("größe µ.txt", "text/plain", b"new")], 5)
    now = path.read_bytes()
    assert now.startswith(before[:before.rindex(b"\x0f" + (4).to_bytes(8, "little"))])  # DataEnd
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        assert [m.data for _, _, m in reader.iter_messages()] == [b"%d" % n for n in range(300)]
    with path.open("rb") as file:
        found = [(a.name, a.data) for a in NonSeekingReader(file).iter_attachments()]
    assert found == [("x.txt", b"0"), ("größe µ.txt", b"new")]
    with path.open("rb") as file:
        assert make_reader(file).get_summary().statistics.attachment_count == 2
    assert attached(path)["größe µ.txt"] == b"new"


def test_a_file_without_any_summary_is_left_alone(tmp_path):
    path = foreign(tmp_path / "a.mcap", use_statistics=False, use_summary_offsets=False,
                   index_types=IndexType.NONE, repeat_channels=False, repeat_schemas=False)
    before = path.read_bytes()
    with pytest.raises(InputError, match="not an MCAP file with a summary"):
        attach(path, [("a", "", b"")], 1)
    assert path.read_bytes() == before


@pytest.mark.parametrize("others", ["attach", "append"])
def test_what_another_program_writes_meanwhile_is_not_lost(bag, monkeypatch, others):
    """Two at once: the second that ends is refused, and the first is in the bag."""
    copy, path = attachments._copy, file_in(bag)

    def meanwhile(*args):
        copy(*args)
        monkeypatch.setattr(attachments, "_copy", copy)
        if others == "attach":
            attach(bag, [("first.txt", "", b"1")], 1)
        else:
            with path.open("ab") as file:
                file.write(b"more")
    monkeypatch.setattr(attachments, "_copy", meanwhile)
    with pytest.raises(InputError, match="another program has written to it meanwhile; embed ag"):
        attach(bag, [("second.txt", "", b"2")], 2)
    if others == "attach":
        attach(bag, [("second.txt", "", b"2")], 3)
        assert attached(bag) == {"first.txt": b"1", "second.txt": b"2"}
    else:
        assert path.read_bytes().endswith(b"more")
    assert [one.name for one in bag.glob(".*")] == []  # nothing is left behind


def test_attachments_of_any_names_come_out_as_different_files_of_one_folder(tmp_path):
    names = ["x.txt", "x.txt", "../x.txt", "", "..", "a/b\\c", "n\0l\n", "x.txt (2)"]
    path, out = foreign(tmp_path / "a.mcap", names), tmp_path / "out"
    out.mkdir()
    assert main(["embed", str(path), "--extract", str(out)]) == 0
    assert {one.name: int(one.read_bytes()) for one in out.iterdir()} == {
        "x.txt": 0, "x.txt (2)": 1, "x.txt (3)": 2, "attachment": 3, "attachment (2)": 4, "c": 5,
        "n_l_": 6, "x.txt (2) (2)": 7}
    assert {one.name for one in tmp_path.iterdir()} == {"a.mcap", "out"}


def test_a_file_with_other_content_is_not_written_over(tmp_path, capsys):
    path, out = foreign(tmp_path / "a.mcap", ["x.txt", "y.txt"]), tmp_path / "out"
    out.mkdir()
    (out / "y.txt").write_text("newer")
    assert main(["embed", str(path), "--extract", str(out)]) == 2
    assert "y.txt: the file exists with other contents; extract to" in capsys.readouterr().err
    assert (out / "y.txt").read_text() == "newer" and not (out / "x.txt").exists()
    (out / "y.txt").write_bytes(b"1")
    assert main(["embed", str(path), "--extract", str(out)]) == 0


@pytest.mark.parametrize("name", [b"bad\xff.txt", b"two\nlines"])
def test_a_name_that_cannot_be_printed_is_one_line(bag, tmp_path, capsys, name):
    path = tmp_path / os.fsdecode(name)
    path.write_text("x")
    before = file_in(bag).read_bytes()
    assert main(["embed", str(bag), str(path)]) == 2
    err = capsys.readouterr().err
    assert "has characters that cannot be printed; rename the file" in err and err.count("\n") == 1
    assert file_in(bag).read_bytes() == before


def test_folders_and_pipes_named_like_a_file_of_a_bag_are_none(bag, tmp_path):
    [file] = bag_files(bag)
    (bag / "folder.mcap").mkdir()
    os.mkfifo(bag / "pipe.mcap")
    assert bag_files(bag) == [file]
    with pytest.raises(InputError):
        result_bytes(tmp_path)


@pytest.mark.skipif(not os.access("/proc/kmsg", os.R_OK), reason="needs the log of the kernel")
def test_a_file_that_gives_nothing_yet_is_not_waited_for():
    log = os.open("/proc/kmsg", os.O_RDONLY | os.O_NONBLOCK)
    try:
        with contextlib.suppress(BlockingIOError):
            while os.read(log, 8192):
                pass
        assert bag_files(Path("/proc/kmsg")) == []
    finally:
        os.close(log)


def test_a_bag_that_is_write_protected_is_left_alone(bag, tmp_path, capsys):
    """The folder is not: a new file in place of the bag would be possible."""
    note, [file] = tmp_path / "note.txt", sorted(bag.glob("*.mcap"))
    note.write_text("n")
    before = file.read_bytes()
    file.chmod(0o444)
    assert main(["embed", str(bag), str(note)]) == 2
    assert capsys.readouterr().err == (f"selfcal embed: {file}: is write-protected; allow writing "
                                       "to it, or take a copy\n")
    assert file.read_bytes() == before

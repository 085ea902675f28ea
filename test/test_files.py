# SPDX-License-Identifier: Apache-2.0
"""Files: a write is whole or not at all, faults name file and place, YAML as ROS reads it."""

import hashlib
import json
import math
import os
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros import files
from selfcal_ros.errors import InputError
from selfcal_ros.files import (
    read_bytes,
    read_json,
    read_text,
    read_yaml,
    sha256_of,
    write_yaml,
)
from selfcal_ros.outputs import (
    atomic_file,
    check_outputs,
    json_text,
    sweep,
    temporary_folder,
    write_bytes,
    write_json,
    write_text,
)

ROOT = Path(__file__).parents[1]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def yaml_of(folder, text):
    path = folder / "x.yaml"
    path.write_text(text)
    found = read_yaml(path)
    for loader in files.LOADERS:  # each by itself
        assert repr(yaml.load(text, loader)) == repr(found)
    return found


@pytest.fixture(params=["all ways", "without libyaml"])
def loaders(request, monkeypatch):
    """Read as where libyaml is, and as where it is not."""
    if request.param == "without libyaml":
        monkeypatch.setattr(files, "LOADERS", [files.YamlLoader])


class Crash(Exception):
    pass


@pytest.mark.parametrize("crash", [Crash, KeyboardInterrupt, SystemExit])
def test_a_crash_in_the_middle_keeps_the_old_file_and_leaves_no_other(tmp_path, crash):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def torn():
        with atomic_file(path) as file:
            file.write(b"half of the n")
            file.flush()
            assert path.read_bytes() == b"old"
            raise crash

    with pytest.raises(crash):
        torn()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_a_full_disk_is_one_line_and_keeps_the_old_file(tmp_path, monkeypatch, step):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    def write():
        with atomic_file(path) as file:
            if step == "write":
                fail()
            else:
                monkeypatch.setattr(files.os, step, fail)
                file.write(b"new")

    with pytest.raises(
        InputError, match=r"a\.json: cannot be written \(No space left on device\)"
    ):
        write()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.json"]


KILLED = """
import os, signal, sys
from pathlib import Path
from selfcal_ros.outputs import atomic_file, temporary_folder
folder = Path(sys.argv[1])
with temporary_folder(folder) as beside, atomic_file(folder / "a.json") as file:
    (beside / "half").write_text("of a bag")
    file.write(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_next_write_removes_what_killed_processes_left(tmp_path):
    kept = [
        ".selfcal.settings",
        ".selfcal.0123456789abcdef.json",
        ".selfcal.0123456789abcdeg",
    ]
    for name in kept:
        (tmp_path / name).write_text("not ours")
    (tmp_path / ".selfcal.00000000000000aa").symlink_to(tmp_path / kept[0])
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path)], check=False, cwd=ROOT
    )
    assert killed.returncode == -signal.SIGKILL
    assert len(names(tmp_path)) == len(kept) + 3
    write_bytes(tmp_path / "b", b"whole")
    assert names(tmp_path) == sorted([*kept, ".selfcal.00000000000000aa", "b"])


def test_what_is_still_being_written_is_left_alone(tmp_path):
    with atomic_file(tmp_path / "a") as file, temporary_folder(tmp_path) as beside:
        file.write(b"a")
        (beside / "part").write_text("of a bag")
        sweep.cache_clear()
        write_bytes(tmp_path / "b", b"b")
        assert (beside / "part").exists()
    assert names(tmp_path) == ["a", "b"]
    assert (tmp_path / "a").read_bytes() == b"a"


def test_endless_devices_are_refused():
    with pytest.raises(InputError, match="/dev/zero: is a device"):
        read_text("/dev/zero")


def test_a_name_that_is_not_utf8_can_be_written_and_read_as_utf8(tmp_path):
    write_text(tmp_path / "a", os.fsdecode(b"n\xff.mcap"))
    assert read_text(tmp_path / "a") == "n\\udcff.mcap"


def test_a_write_replaces_all_of_the_old_file(tmp_path):
    write_bytes(tmp_path / "a", b"something long")
    write_bytes(tmp_path / "a", b"short")
    assert (tmp_path / "a").read_bytes() == b"short"
    write_text(tmp_path / "a", "µ")
    assert (tmp_path / "a").read_bytes() == b"\xc2\xb5"
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_a_new_file_has_the_permissions_that_the_umask_leaves(tmp_path, umask):
    before = os.umask(umask)
    try:
        write_bytes(tmp_path / "a", b"")
        assert os.umask(umask) == umask, "the umask of the process is what it was"
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o666 & ~umask


def test_an_old_file_keeps_its_permissions(tmp_path):
    (tmp_path / "a").touch()
    (tmp_path / "a").chmod(0o640)
    write_bytes(tmp_path / "a", b"new")
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "b").write_bytes(b"old")
    (tmp_path / "a").symlink_to("there/b")
    write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").is_symlink()
    assert (tmp_path / "there" / "b").read_bytes() == b"new"


def test_what_is_no_file_is_written_into_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_bytes(pipe, b"through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("none/a", "No such file or directory"),
        ("file/a", "Not a directory"),
        ("folder", "Is a directory"),
        ("n" * 300, "File name too long"),
    ],
)
def test_where_nothing_can_be_written(tmp_path, target, reason):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError) as caught:
        write_bytes(tmp_path / target, b"x")
    assert str(caught.value) == (
        f"{tmp_path / target}: cannot be written ({reason}); name an existing, writable folder"
    )
    assert names(tmp_path) == ["file", "folder"]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("none", "no such file; check the path"),
        ("", "cannot be read (Is a directory); name a readable file"),
        ("a\0b", "cannot be read (embedded null byte); name a readable file"),
        ("n" * 300, "cannot be read (File name too long); name a readable file"),
    ],
)
def test_what_cannot_be_read(tmp_path, source, message):
    for read in (read_bytes, read_text, read_json, read_yaml):
        with pytest.raises(InputError) as caught:
            read(tmp_path / source)
        assert str(caught.value) == f"{tmp_path / source}: {message}".replace(
            "\0", "\\x00"
        )


@pytest.mark.parametrize("path", ["pipe", "/dev/zero", "/dev/tty", "socket"])
def test_with_a_limit_only_regular_files_are_read(tmp_path, monkeypatch, path):
    """A device is not even opened: that may do something."""
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as ear:
        ear.bind(str(tmp_path / "socket"))
        monkeypatch.setattr(files.os, "open", lambda *_: pytest.fail("opened"))
        with pytest.raises(
            InputError, match=r": is not a regular file; name a file on a disk$"
        ):
            read_bytes(tmp_path / path, 100)


def test_a_file_that_becomes_a_pipe_while_it_is_opened_is_not_waited_for(
    tmp_path, monkeypatch
):
    (tmp_path / "a").write_bytes(b"x")
    os.mkfifo(tmp_path / "pipe")
    opened = os.open
    monkeypatch.setattr(
        files.os, "open", lambda _, flags: opened(tmp_path / "pipe", flags)
    )
    with pytest.raises(InputError, match="is not a regular file"):
        read_bytes(tmp_path / "a", 100)


def test_with_a_limit_a_file_has_that_many_bytes_or_is_refused(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(InputError) as caught:
        read_bytes(tmp_path / "a", 4)
    assert str(caught.value) == (
        f"{tmp_path / 'a'}: has 5 bytes, more than 4; name a smaller file"
    )
    assert read_bytes("/proc/self/pagemap", 5) == b"", (
        "the kernel makes it up, without end"
    )


def test_json_of_too_many_values_is_refused_where_somebody_waits(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_JSON_VALUES", 3)
    (tmp_path / "a").write_text("[1, 2, 3, 4]")
    assert read_json(tmp_path / "a") == [1, 2, 3, 4]
    with pytest.raises(InputError, match="more than 3 values; name a smaller file"):
        read_json(tmp_path / "a", 100)
    (tmp_path / "a").write_text("[1, 2, 3]")
    assert read_json(tmp_path / "a", 100) == [1, 2, 3]


def test_text_that_is_not_utf8(tmp_path):
    (tmp_path / "a").write_bytes(b"abc\xff")
    for read in (read_text, read_json, read_yaml):
        with pytest.raises(
            InputError, match="a: byte 3: not UTF-8 text; save the file as UTF-8"
        ):
            read(tmp_path / "a")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1,\n "b": }', ":2:7: not JSON (Expecting value)"),
        ("", ":1:1: not JSON (Expecting value)"),
        ("[" * 100_000, ": not usable JSON ("),
        ("9" * 5000, ": not usable JSON (a whole number"),
    ],
)
def test_faults_in_json(tmp_path, text, message):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read_json(tmp_path / "a.json")
    assert str(caught.value).startswith(f"{tmp_path / 'a.json'}{message}")
    assert str(caught.value).endswith("; give a file that `selfcal` wrote")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "a: 1\nb: [",
            ":2:5: not YAML (expected the node content, but found '<stream end>')",
        ),
        ("a: &x 1\nb: *y", ":2:4: not YAML (found undefined alias 'y')"),
        (
            "a: !!python/name:os.system ''",
            ":1:4: not YAML (could not determine a constructor",
        ),
        ("a: \x01", ": not YAML; give a YAML text file"),
        (
            "a: {b: 1,\n    c: !!int ''}",
            ":2:8: not YAML (not a value of the type int); correct the line",
        ),
        ("!!bool perhaps", ":1:1: not YAML (not a value of the type bool)"),
        ("- !!timestamp x", ":1:3: not YAML (not a value of the type timestamp)"),
        ("a: 2001-13-40", ":1:4: not YAML (month must be in 1..12); correct the line"),
        ("[" * 2_000, ": not usable YAML (maximum recursion depth"),
    ],
)
@pytest.mark.usefixtures("loaders")
def test_faults_in_yaml(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        yaml_of(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'x.yaml'}{message}")


def test_json_is_strict_and_comes_back(tmp_path):
    path = tmp_path / "a.json"
    value = {"b": [1, 2.5, None, True], "a": "µ"}
    write_json(path, value)
    assert read_json(path) == value
    assert path.read_text().endswith("}\n")
    with pytest.raises(ValueError):
        write_json(path, {"a": math.nan})
    assert read_json(path) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5e-4", 5e-4),
        ("1e3", 1e3),
        ("1E+3", 1e3),
        ("-2e-6", -2e-6),
        ("+3e2", 3e2),
        ("1.e3", 1e3),
        ("1.0e3", 1e3),
        ("1.7e9", 1.7e9),
        (".5e1", 5.0),
        ("-.5e-1", -0.05),
        ("-.5", -0.5),
        ("00e0", 0.0),
        ("2.0e-7", 2e-7),
        ("-.inf", -math.inf),
    ],
)
def test_floats_as_ros_reads_them(tmp_path, text, value):
    found = yaml_of(tmp_path, f"a: {text}\nb: [{text}, {{c: {text}}}]")
    assert found == {"a": value, "b": [value, {"c": value}]}
    assert type(found["a"]) is float
    assert float(text.replace(".inf", "inf")) == value


@pytest.mark.parametrize(
    "text",
    [
        "1e3abc",
        "'5e-4'",
        '"5e-4"',
        "!!str 5e-4",
        "e3",
        "1e",
        "1e+",
        "1e3.5",
        "1 e3",
        ".e3",
        "1_0e3",
        "--1e3",
        "0x1e3",
        "1e3e4",
        "x1e3",
        "+",
        ".",
        "...x",
        "1.2.3",
        "1-2e3",
        "true",
        "off",
        "~",
        "7",
        "0x1f",
        "2.5",
        ".nan",
        "2001-01-02",
        "1e3:4",
        "1e3 # x",
        "|\n 5e-4",
        "5e-4 m",
    ],
)
def test_everything_else_stays_what_it_was(tmp_path, text):
    found = yaml_of(tmp_path, f"a: {text}\n")["a"]
    expected = yaml.safe_load(f"a: {text}\n")["a"]
    if text == "1e3 # x":
        expected = 1e3
    assert type(found) is type(expected)
    assert found == expected or (math.isnan(found) and math.isnan(expected))


def test_the_loader_of_others_is_left_alone():
    assert yaml.safe_load("5e-4") == "5e-4"


WHOLE = st.integers(-(2**63), 2**63 - 1)
ANY = st.characters(exclude_categories=["Cs"])
"""Said by a codec instead, as by default, Hypothesis first tries all characters for 2 s."""
PLAIN = st.one_of(
    st.none(),
    st.booleans(),
    WHOLE,
    st.floats(allow_nan=False),
    st.text(ANY),
    st.from_regex(r"\A[-+]?[0-9]*\.?[0-9]*[eE]?[-+]?[0-9]*\Z", alphabet=ANY),
)


@given(
    value=st.recursive(
        PLAIN,
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.text(ANY, max_size=5), inner, max_size=3)
        ),
        max_leaves=8,
    )
)
def test_yaml_that_is_written_comes_back(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("yaml") / "x.yaml"
    write_yaml(path, value)
    for found in (
        read_yaml(path),
        *(yaml.load(path.read_text(), loader) for loader in files.LOADERS),
    ):
        assert found == value
        assert repr(found) == repr(value)


def test_keys_are_written_in_their_order(tmp_path):
    write_yaml(tmp_path / "x.yaml", {"b": 1, "a": "1e3"})
    assert (tmp_path / "x.yaml").read_text() == "b: 1\na: '1e3'\n"


def test_digests_of_files_and_of_folders(tmp_path):
    (tmp_path / "f" / "b").mkdir(parents=True)
    (tmp_path / "f" / "b" / "1").write_bytes(b"one")
    (tmp_path / "f" / "a").write_bytes(b"two")
    assert sha256_of(tmp_path / "f" / "a") == hashlib.sha256(b"two").hexdigest()
    assert sha256_of(tmp_path / "f") == hashlib.sha256(b"twoone").hexdigest()
    with pytest.raises(InputError, match=r"none: cannot be read \(No such file"):
        sha256_of(tmp_path / "none")


def test_outputs_are_refused_that_cannot_all_be_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    (tmp_path / "in.csv").write_text("")
    (tmp_path / "link.json").symlink_to("in.csv")
    for outputs, message in (
        (["in.csv"], "in.csv: would be overwritten"),
        (["link.json"], "link.json: would be overwritten"),
        (["bag/metadata.yaml"], "bag/metadata.yaml: would be overwritten"),
        (["a", "./a"], "./a: would be overwritten"),
        (["bag"], "bag: it is a folder"),
        (["a", "no/a"], r"no/a: cannot be written \(No such file"),
    ):
        with pytest.raises(InputError, match="^" + message):
            check_outputs(["in.csv", "bag", None], outputs)
    check_outputs(["in.csv", None], ["a", "b", None, os.devnull, os.devnull])


def test_what_json_writes_is_what_json_reads(tmp_path):
    write_json(tmp_path / "a", [0.1, 1e-300, -0.0])
    assert json.loads((tmp_path / "a").read_text()) == [0.1, 1e-300, -0.0]


@pytest.mark.parametrize(
    "text, problem",
    [
        (
            "a: 1\nb: 2\na: 3\n",
            r"f\.yaml:3:1: not YAML \(the key 'a' is given twice\); correct the line",
        ),
        ("a: {b: 1, b: 1}\n", r"f\.yaml:1:11: not YAML \(the key 'b' is given twice\)"),
        (
            "a: " + "9" * 400,
            r"f\.yaml:1:4: not YAML \(a whole number beyond 64 bits\); correct",
        ),
        (
            "a: 045",
            r"f\.yaml:1:4: not YAML \(programs differ on what number 045 is: write",
        ),
        ("a: [0, -010]", r"f\.yaml:1:8: not YAML \(programs differ .* number -010 is"),
        ("a: 45:30", "what number 45:30 is: write it without leading 0, _ and :"),
        ("a: 1_000", r"what number 1_000 is"),
        ("a: 1:30.5", r"what number 1:30\.5 is"),
        ("a: 0.000_1", r"what number 0\.000_1 is"),
        ("a:\n  b: 2026-13-45", r"f\.yaml:2:6: not YAML \(month must be in 1\.\.12\)"),
        ("a: 9223372036854775808", "a whole number beyond 64 bits"),
        ("a: -9223372036854775809", "a whole number beyond 64 bits"),
        ("a: &a [*a]", "its aliases expand to more than 50000 values"),
        (
            "\n".join(
                ["a0: &a0 [0, 0]"]
                + [
                    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]"
                    for i in range(1, 12)
                ]
            ),
            r"f\.yaml:1:1: not YAML \(its aliases expand to more than 50000 values\)",
        ),
    ],
)
@pytest.mark.usefixtures("loaders")
def test_yaml_that_means_harm_or_is_ambiguous_is_refused(tmp_path, text, problem):
    path = tmp_path / "f.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=problem):
        files.read_yaml(path)


@pytest.mark.usefixtures("loaders")
def test_yaml_is_bounded_while_it_is_parsed(tmp_path, monkeypatch):
    """What follows the last value that there may be is not looked at: there is no fault in it."""
    monkeypatch.setattr(files, "MAX_YAML_NODES", 5)
    path = tmp_path / "f.yaml"
    path.write_text("[1, 2, 3, 4]")
    assert files.read_yaml(path) == [1, 2, 3, 4]
    path.write_text("- 1\n- 2\n- 3\n- 4\n- 5\n]")
    with pytest.raises(
        InputError, match=r"f\.yaml:5:3: not YAML \(more than 5 values\)"
    ):
        files.read_yaml(path)
    monkeypatch.setattr(files, "MAX_YAML_BYTES", 8)
    with pytest.raises(
        InputError, match="has 21 bytes, more than 8; name a smaller file"
    ):
        files.read_yaml(path)


def test_a_large_faulty_document_is_read_once(tmp_path, monkeypatch):
    """The second way, which has the better words, takes five times as long."""
    monkeypatch.setattr(files, "EXPLAINED", 4)
    monkeypatch.setattr(files, "LOADERS", [files.LOADERS[0], None])
    with pytest.raises(InputError, match=r"x\.yaml:1:7: not YAML \("):
        (tmp_path / "x.yaml").write_text("a: 'bc")
        read_yaml(tmp_path / "x.yaml")


def test_a_number_without_end_takes_no_time(tmp_path):
    """Half a million digits: what tried each way to split them would not come back."""
    assert yaml_of(tmp_path, f"a: {'9' * 500_000}.x")["a"].endswith("9.x")


@pytest.mark.parametrize(
    "text, value",
    [
        ("a: &a [1, 2]\nb: *a\n", {"a": [1, 2], "b": [1, 2]}),
        ("a: &a {x: 1}\nb:\n  <<: *a\n  x: 2\n", {"a": {"x": 1}, "b": {"x": 2}}),
        ("a: 9223372036854775807", {"a": 2**63 - 1}),
        ("a: -9223372036854775808", {"a": -(2**63)}),
        ("a: 0x1F", {"a": 31}),
        ("1: a\n'1': b\n", {1: "a", "1": "b"}),
    ],
)
def test_honest_yaml_is_read(tmp_path, text, value):
    assert yaml_of(tmp_path, text) == value


@pytest.mark.parametrize("digits", [20, 400, 5000])
def test_json_with_a_whole_number_beyond_64_bits_is_refused_without_its_digits(
    tmp_path, digits
):
    path = tmp_path / "f.json"
    path.write_text('{"a": ' + "9" * digits + "}")
    with pytest.raises(InputError) as caught:
        files.read_json(path)
    assert str(caught.value) == (
        f"{path}: not usable JSON (a whole number beyond 64 bits); give a file that `selfcal` wrote"
    )


@settings(max_examples=50)
@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats(allow_nan=False, allow_infinity=False)
        | st.text(ANY),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(ANY), inner),
        max_leaves=20,
    )
)
def test_json_is_read_back_whatever_its_lines(value):
    assert json.loads(json_text(value)) == value


def test_a_row_of_numbers_is_a_line():
    assert json_text({"a": [[1.5, None], []], "b": {}, "c": [{"d": 1}]}) == (
        '{\n "a": [\n  [1.5, null],\n  []\n ],\n "b": {},\n "c": [\n  {\n   "d": 1\n  }\n ]\n}'
    )
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text({"a": [float("nan")]})

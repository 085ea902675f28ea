# SPDX-License-Identifier: Apache-2.0
"""`selfcal trace`: of which result an export is; and results that are read from a bag."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.apply import load
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.files import sha256_of
from selfcal_ros.results import read_result
from test.support.pages import ROOT

EXPORTS = {
    "t.csv": "table r.json -o t.csv", "t.npz": "table r.json -o t.npz",
    "s.cal": "cal export r.json -o s.cal", "o.cal": "cal orthogonality r.json -o o.cal",
    "k.txt": "export kmotion r.json -o k.txt", "c.ini": "export siemens r.json -o c.ini",
    "p.pmc": "export pmac r.json -o p.pmc --counts-per-unit 1=20000 --counts-per-unit 2=20000",
    "b_x.lis": "export beckhoff r.json -o b.lis", "l_y.txt": "export linuxcnc r.json -o l.txt",
    "a.csv": "apply r.json points.csv -o a.csv",
    "g.nc": "gcode in.nc r.json -o g.nc --dialect grbl",
    "dcc.xml": "certificate r.json details.yaml -o dcc.xml"}


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """Return a folder with a bag, its result, and what the exports need."""
    folder = tmp_path_factory.mktemp("shelf")
    shutil.copytree(ROOT / "bags/hu_noise", folder / "bag")
    shutil.copy(ROOT / "config/certificates/details.yaml", folder)
    (folder / "points.csv").write_text("x,y\n0.01,0.02\n")
    (folder / "in.nc").write_text("%\n(part)\nG21 G90\nG0 X1 Y2\n")
    assert main(["solve", str(folder / "bag"), "--quiet", "-o", str(folder / "r.json")]) == 0
    return folder


@pytest.fixture
def here(shelf, tmp_path, monkeypatch):
    folder = tmp_path / "work"
    shutil.copytree(shelf, folder)
    monkeypatch.chdir(folder)
    return folder


def refused(capsys, *words):
    """Return the one line with which a trace fails."""
    capsys.readouterr()
    assert main(["trace", *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said.removeprefix("selfcal trace: ")


@pytest.mark.parametrize("name", EXPORTS)
def test_every_export_is_traced_to_its_result_until_either_changes(name, here, capsys):
    assert main(EXPORTS[name].split()) == 0
    capsys.readouterr()
    assert main(["trace", name, "--json"]) == 0
    [found] = json.loads(capsys.readouterr().out)["files"]
    assert found["command"] == f"selfcal {EXPORTS[name]}"
    assert found["result_sha256"] == sha256_of("r.json") and found["result"] == "r.json"
    whole = Path(name).read_bytes()
    Path(name).write_bytes(whole.replace(b"0", b"1", 1))
    assert refused(capsys, name).startswith(f"{name}: was changed after its export on 20")
    Path(name).write_bytes(whole)
    assert main(["trace", name]) == 0
    Path("r.json").write_text(Path("r.json").read_text() + " ")
    assert refused(capsys, name).startswith(f"{name}: r.json is not the result that it was ")
    Path("r.json").unlink()
    assert refused(capsys, name).startswith("r.json: no such file")


@pytest.mark.parametrize("name", ["s.cal", "o.cal", "k.txt", "c.ini", "p.pmc", "b_x.lis",
                                  "l_y.txt", "g.nc", "dcc.xml"])
def test_formats_with_comments_hold_digest_and_command(name, here):
    assert main(EXPORTS[name].split()) == 0
    text = Path(name).read_text()
    assert sha256_of("r.json") in text
    assert name == "dcc.xml" or f"command: selfcal {EXPORTS[name]}" in text


def test_the_comment_of_a_program_follows_its_beginning(here):
    assert main(EXPORTS["g.nc"].split()) == 0
    first, second, *_ = Path("g.nc").read_text().splitlines()
    assert (first, second) == ("%", f"; command: selfcal {EXPORTS['g.nc']}")


def test_comments_of_a_program_fit_into_the_lines_of_linuxcnc(here):
    long = here / ("x" * 120) / ("y" * 120) / "é.json"
    long.parent.mkdir(parents=True)
    shutil.copy("r.json", long)
    assert main(["gcode", "in.nc", str(long), "-o", "g.nc", "--dialect", "linuxcnc"]) == 0
    assert all(len(line) < 256 and line.isascii() for line in Path("g.nc").read_text().splitlines())


def test_a_folder_is_moved_with_its_records(here, tmp_path, capsys, monkeypatch):
    assert main(["table", "r.json", "-o", str(here / "t.csv")]) == 0
    (tmp_path / "moved").mkdir()
    here.rename(tmp_path / "moved" / "work")
    monkeypatch.chdir(tmp_path)
    assert main(["trace", "moved/work/t.csv"]) == 0
    assert "t.csv: unchanged, from moved/work/r.json (SHA-256 " in capsys.readouterr().out


def test_a_bag_with_result_and_exports_is_complete(here, capsys):
    for name in ("k.txt", "t.csv"):
        assert main(EXPORTS[name].split()) == 0
    assert refused(capsys, "bag").startswith("bag: no exported file with its record is in it")
    assert main(["embed", "bag", "k.txt", "t.csv"]) == 0
    assert refused(capsys, "bag").startswith("bag/k.txt: no file in the bag is not")
    assert main(["trace", "bag", "--result", "r.json"]) == 0
    assert main(["embed", "bag", "r.json"]) == 0
    capsys.readouterr()
    assert main(["trace", "bag"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split(" (")[0] for line in said] == [
        f"bag/{name}: unchanged, from r.json" for name in ("k.txt", "t.csv")]


def test_an_edited_export_is_not_embedded(here, capsys):
    assert main(EXPORTS["k.txt"].split()) == 0
    Path("k.txt").write_text(Path("k.txt").read_text().replace("1", "2", 1))
    assert main(["embed", "bag", "k.txt"]) == 2
    assert "k.txt: was changed after its export" in capsys.readouterr().err


@pytest.mark.parametrize(("record", "message"), [
    ("{}", "not a record of schema selfcal.origin/1"), ("[1]", "not a record"), ("{", "not JSON"),
    ('{"schema": "selfcal.origin/1", "file": 1}', "not a record"),
    ('{"schema": "selfcal.origin/1", "file": "", "sha256": "", "created": "", "command": "", '
     '"result": {"file": 3}}', "not a record"),
    (None, "has no record t.csv.origin.json next to it; export it again")])
def test_what_is_no_record_is_one_line(record, message, here, capsys):
    Path("t.csv").write_text("x\n")
    if record is not None:
        Path("t.csv.origin.json").write_text(record)
    assert message in refused(capsys, "t.csv")


def test_every_verb_reads_the_result_in_a_bag(here, capsys):
    """Of a bag with one result the bag is named, of one with several BAG/NAME."""
    assert main(["embed", "bag", "r.json", "details.yaml"]) == 0
    for line in [*EXPORTS.values(), "report r.json -o r.html", "plot r.json -o m.svg",
                 "diff r.json r.json", "cal verify r.json s.cal", "iso230 r.json",
                 "recheck r.json ../work/bag -o again.json"]:
        assert main(line.replace("r.json", "bag").split()) == 0, line
    found, wanted = load("bag").error(0.01, 0.02), load("r.json").error(0.01, 0.02)
    np.testing.assert_array_equal(found, wanted)
    shutil.copy("r.json", "second.json")
    assert main(["embed", "bag", "second.json"]) == 0
    capsys.readouterr()
    assert main(["table", "bag", "-o", "-"]) == 2
    assert capsys.readouterr().err == ("selfcal table: bag: 2 results are embedded; name one as "
                                       "bag/NAME: r.json, second.json\n")
    assert main(["table", "bag/second.json", "-o", "-"]) == 0
    assert read_result("bag/second.json").read_from == ("bag/second.json", sha256_of("r.json"))
    file = str(next(Path("bag").glob("*.mcap")))
    assert read_result(f"{file}/second.json").plan_id == read_result("r.json").plan_id


@pytest.mark.parametrize(("name", "message"), [
    ("bag", "bag: no results are embedded; embed one with `selfcal embed`; embedded is nothing"),
    ("bag/x.json", "bag/x.json: no results are embedded"), ("none", "none: no such file"),
    ("none/x.json", "none/x.json: no such file")])
def test_a_bag_without_the_result_is_one_line(name, message, here):
    with pytest.raises(InputError) as caught:
        read_result(name)
    assert str(caught.value).startswith(message)


def test_a_request_reads_no_more_than_it_may(here):
    assert main(["embed", "bag", "r.json"]) == 0
    with pytest.raises(InputError, match="more than 1000"):
        read_result("bag", 1000)

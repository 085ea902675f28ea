# SPDX-License-Identifier: Apache-2.0
"""Every export states in its header which result it was made from."""

import shutil
from pathlib import Path

import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.files import sha256_of
from test.support.pages import ROOT

EXPORTS = {
    "s.cal": "cal export r.json -o s.cal",
    "o.cal": "cal orthogonality r.json -o o.cal",
    "k.txt": "export kmotion r.json -o k.txt",
    "c.ini": "export siemens r.json -o c.ini",
    "p.pmc": "export pmac r.json -o p.pmc --counts-per-unit 1=20000 --counts-per-unit 2=20000",
    "b_x.lis": "export beckhoff r.json -o b.lis",
    "l_y.txt": "export linuxcnc r.json -o l.txt",
    "g.nc": "gcode in.nc r.json -o g.nc --dialect grbl",
    "dcc.xml": "certificate r.json details.yaml -o dcc.xml",
}


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """Return a folder with a bag, its result, and what the exports need."""
    folder = tmp_path_factory.mktemp("shelf")
    shutil.copytree(ROOT / "bags/hu_noise", folder / "bag")
    shutil.copy(ROOT / "config/certificates/details.yaml", folder)
    (folder / "in.nc").write_text("%\n(part)\nG21 G90\nG0 X1 Y2\n")
    assert (
        main(["solve", str(folder / "bag"), "--quiet", "-o", str(folder / "r.json")])
        == 0
    )
    return folder


@pytest.fixture
def here(shelf, tmp_path, monkeypatch):
    folder = tmp_path / "work"
    shutil.copytree(shelf, folder)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_holds_digest_and_command(name, here):
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
    assert (
        main(["gcode", "in.nc", str(long), "-o", "g.nc", "--dialect", "linuxcnc"]) == 0
    )
    assert all(
        len(line) < 256 and line.isascii()
        for line in Path("g.nc").read_text().splitlines()
    )

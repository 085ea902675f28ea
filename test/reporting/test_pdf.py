# SPDX-License-Identifier: Apache-2.0
import re
from dataclasses import replace

import pytest

from selfcal_ros.aerotech.verify import table_chapter
from selfcal_ros.errors import InputError
from selfcal_ros.reporting import pdf
from selfcal_ros.reporting.chapters import Chapter, heading
from selfcal_ros.reporting.pdf import COLUMNS, _lines, report_pdf
from selfcal_ros.reporting.report import write_report
from selfcal_ros.reporting.summary.sections import Section
from test.support.results import chapters_of, known_result, with_residuals

SMALL = replace(known_result(3, 0)[0], plan_id=r"$\frac{ \n 長", warnings=("$x$ \x1b[2J",))
"""A result with names of the user that neither matplotlib nor its font understands."""


@pytest.fixture(scope="module")
def small():
    return report_pdf(SMALL, chapters_of(SMALL), heading(SMALL, {}))


def pages_of(data):
    return len(re.findall(rb"/Type /Page\b(?!s)", data))


def test_a_pdf_has_pages_and_is_the_same_bytes_for_the_same_result(tmp_path, small):
    assert small.startswith(b"%PDF") and small.rstrip().endswith(b"%%EOF")
    assert b"/CreationDate" not in small and b"/FontFile2" in small  # TrueType
    write_report(SMALL, tmp_path / "a.pdf", more=[table_chapter(SMALL)])
    assert (tmp_path / "a.pdf").read_bytes() == small


def test_residuals_take_pages_of_their_own(small, monkeypatch):
    """Pages are counted, not read: their letters are left as outlines, which is cheaper."""
    monkeypatch.setitem(pdf.EMBEDDED, "pdf.fonttype", 3)
    long = with_residuals()
    data = report_pdf(long, chapters_of(long), heading(long, {}))
    assert pages_of(data) >= max(4, pages_of(small) + 1)


def test_figures_stand_side_by_side_on_the_page(monkeypatch):
    boxes = []
    monkeypatch.setattr(pdf, "put", lambda drawing, axes, scale: boxes.append(axes.get_position()))
    report_pdf(SMALL, chapters_of(SMALL), heading(SMALL, {}))
    assert len(boxes) > 2
    assert all(0 < box.x0 < box.x1 < 1 and 0 < box.y0 < box.y1 < 1 for box in boxes)
    assert boxes[0].x1 < boxes[1].x0
    assert boxes[0].y1 == pytest.approx(boxes[1].y1)


def test_no_line_is_wider_than_the_page_and_no_cell_is_lost():
    words = [f"word{i}" for i in range(200)]
    rows = tuple(tuple(words[40 * j + 4 * i] * 4 for i in range(9)) for j in range(3))
    section = Section("title", (("label", " ".join(words)),), rows, (" ".join(words),))
    lines = [line for line, _ in _lines(Chapter("c", sections=(section,)))]
    assert max(map(len, lines)) <= COLUMNS
    told = " ".join(lines)
    assert all(told.count(f"{word} ") + told.count(f"{word}\n") >= 1 for word in words[:-1])
    for row in rows:
        assert all(cell in told for cell in row)


def test_the_ending_of_the_name_says_the_form(tmp_path, small, monkeypatch):
    monkeypatch.setattr(pdf, "report_pdf", lambda result, found, head: small)
    result = known_result(3, 0)[0]
    for name, start in (("a.pdf", b"%PDF"), ("a.PDF", b"%PDF"), ("a.html", b"<!DOCTYPE")):
        write_report(result, tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with pytest.raises(InputError, match=r"a\.docx: a report is HTML or PDF; end the name in "
                       r"\.html or \.pdf$"):
        write_report(result, tmp_path / "a.docx")

# SPDX-License-Identifier: Apache-2.0
"""``selfcal batch``: bags found, kept by what they hold, bad ones passed, table and page."""

import csv
import html.parser
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.applications.batch import jobs
from selfcal_ros.applications.batch.folder import RECORDS, RESULTS, find_bags, opened
from selfcal_ros.applications.batch.page import _common_spans, _limits, page_html
from selfcal_ros.applications.batch.table import (
    batch_json,
    csv_text,
    described,
    series_of,
    summary_lines,
)
from selfcal_ros.cli.batch import exit_code
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from test.support.bags import Foreign
from test.support.options import bare
from test.support.sessions import events_of, small_plan
from test.support.truth import hu_plan, random_truth, simulate_measurements
from test.support.waiting import wait_until


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """A folder with four good bags, one that lacks views, one that is not a bag."""
    folder = tmp_path_factory.mktemp("shelf")
    (folder / "deep" / "deeper").mkdir(parents=True)
    for seed, place in enumerate(
        ("a.mcap", "b.mcap", "deep/c.mcap", "deep/deeper/d.mcap")
    ):
        Foreign().write(folder / place, events_of(small_plan(), seed))
    Foreign().write(folder / "few.mcap", events_of(small_plan("0, 90")))
    (folder / "text.mcap").write_text("some words, and no bag at all")
    return folder


def batch(*arguments) -> int:
    return main(["batch", *map(str, arguments)])


def content(folder: Path) -> dict:
    return json.loads((folder / "batch.json").read_text())


def stamps(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (folder / RESULTS).iterdir()}


@pytest.mark.parametrize("name", ["table.csv", "index.html", "batch.json"])
def test_files_that_are_not_of_a_batch_are_not_replaced(shelf, tmp_path, capsys, name):
    (tmp_path / name).write_text("mine")
    (tmp_path / ".lock").touch()  # of another program
    assert batch(shelf / "a.mcap", "-o", tmp_path, "--workers", 1) == 2
    assert capsys.readouterr().err == (
        f"selfcal batch: {tmp_path / name}: the file exists, and is not that of a batch; "
        "name another folder\n"
    )
    assert {path.name for path in tmp_path.iterdir()} == {name, ".lock"}
    assert (tmp_path / name).read_text() == "mine"


def test_good_bags_are_solved_as_solve_does_and_bad_ones_are_passed(
    shelf, tmp_path, capsys
):
    out = tmp_path / "out"
    assert batch(shelf, "-o", out, "--workers", 1) == 2
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == (
        "6 bags: 4 calibrated, 4 of them qualified, 2 without a result; 0 were done before"
    )
    lines = sorted(printed.err.splitlines())
    assert len(lines) == 2
    assert lines[0].startswith(
        f"selfcal batch: {shelf / 'few.mcap'}: the marks that were read do not identify the stage"
    )
    assert lines[1] == (
        f"selfcal batch: {shelf / 'text.mcap'}: not an MCAP file; give an .mcap "
        "file or a rosbag2 folder"
    )
    assert (
        main(
            ["solve", str(shelf / "a.mcap"), "--quiet", "-o", str(tmp_path / "a.json")]
        )
        == 0
    )
    record = next(r for r in content(out)["records"] if r["bag"].endswith("a.mcap"))
    ours, theirs = (
        json.loads(path.read_text())
        for path in (out / record["result"], tmp_path / "a.json")
    )
    for result in (ours, theirs):
        assert result["provenance"].pop("created")
    assert ours == theirs
    assert record["quantities"]["nonorthogonality_arcsec"] == pytest.approx(
        np.degrees(theirs["error_map"]["nonorthogonality"]) * 3600, rel=1e-12
    )
    assert {r["bag"]: r["exit_code"] for r in content(out)["records"]} == {
        str(shelf / name): code
        for name, code in (
            ("a.mcap", 0),
            ("b.mcap", 0),
            ("deep/c.mcap", 0),
            ("deep/deeper/d.mcap", 0),
            ("few.mcap", 3),
            ("text.mcap", 2),
        )
    }


def test_robust_bags_are_solved_as_robust_solve_does(shelf, tmp_path):
    out, alone = tmp_path / "out", tmp_path / "a.json"
    bag = shelf / "a.mcap"
    assert batch(bag, "-o", out, "--workers", 1, "--robust") == 0
    assert main(["solve", str(bag), "--robust", "--quiet", "-o", str(alone)]) == 0
    ours, theirs = (
        json.loads(path.read_text())
        for path in (out / content(out)["records"][0]["result"], alone)
    )
    for result in (ours, theirs):
        assert result["provenance"].pop("created")
    assert ours == theirs
    assert "outliers" in ours


def test_only_what_is_new_is_done(shelf, tmp_path, capsys):
    mine, out = tmp_path / "mine", tmp_path / "out"
    mine.mkdir()
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(shelf / name, mine / name)
    assert batch(mine, "-o", out, "--workers", 1) == 0
    first = stamps(out)
    (mine / "a.mcap").rename(mine / "moved.mcap")
    shutil.copy(shelf / "deep/c.mcap", mine / "c.mcap")
    capsys.readouterr()
    assert batch(mine, "-o", out, "--workers", 1, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told == content(out)
    assert (told["bags"], told["done_before"]) == (3, 2)
    second = stamps(out)
    assert len(second) == 3 and first.items() <= second.items()
    assert sorted(r["bag"] for r in told["records"]) == [
        str(mine / name) for name in ("b.mcap", "c.mcap", "moved.mcap")
    ]
    assert batch(mine, "-o", out, "--workers", 1, "--model", "plate_scale:1e-6") == 0
    third = stamps(out)
    assert len(third) == 6 and second.items() <= third.items()
    assert batch(mine, "-o", out, "--workers", 1, "--redo") == 0
    assert not (second.items() & stamps(out).items())
    Foreign().write(mine / "b.mcap", events_of(small_plan(), 9))
    assert batch(mine, "-o", out, "--workers", 1) == 0
    assert content(out)["done_before"] == 2


def test_a_copy_of_a_bag_counts_once_over_time(shelf, tmp_path):
    shutil.copy(shelf / "a.mcap", tmp_path / "again.mcap")
    assert batch(shelf / "a.mcap", tmp_path / "again.mcap", "-o", tmp_path / "out") == 0
    told = content(tmp_path / "out")
    assert (told["bags"], len(told["series"][0]["bags"])) == (2, 1)
    assert told["done_before"] == 0
    assert len(list((tmp_path / "out" / RECORDS).iterdir())) == 1
    again = tmp_path / "again.mcap", shelf / "a.mcap", "-o", tmp_path / "out"
    assert batch(*again) == 0
    assert content(tmp_path / "out")["done_before"] == 2
    (tmp_path / "out/.lock").unlink()  # copied without files that begin with a dot
    assert batch(*again) == 0
    assert content(tmp_path / "out")["done_before"] == 2
    shutil.rmtree(tmp_path / "out" / RECORDS)
    assert batch(*again) == 0


def test_redo_solves_a_bag_again_that_is_known_by_its_content_alone(
    shelf, tmp_path, monkeypatch
):
    names = [tmp_path / name for name in ("one.mcap", "two.mcap")]
    for name in names:
        shutil.copy(shelf / "a.mcap", name)
    assert batch(*names, "-o", tmp_path / "out", "--workers", 1) == 0
    solved = []
    monkeypatch.setattr(
        jobs,
        "solved",
        lambda job, source, right=jobs.solved: (
            solved.append(job.bag.name),
            right(job, source),
        )[1],
    )
    assert batch(*names, "-o", tmp_path / "out", "--workers", 1) == 0
    assert not solved
    assert batch(*names, "-o", tmp_path / "out", "--workers", 1, "--redo") == 0
    assert sorted(solved) == ["one.mcap", "two.mcap"]
    assert content(tmp_path / "out")["done_before"] == 0


def test_killed_in_the_middle_it_does_only_the_rest(tmp_path):
    bags, out = tmp_path / "bags", tmp_path / "out"
    bags.mkdir()
    for seed in range(12):
        Foreign().write(bags / f"{seed}.mcap", events_of(small_plan(), seed))
    command = [
        sys.executable,
        "-m",
        "selfcal_ros",
        "batch",
        str(bags),
        "-o",
        str(out),
        "--workers",
        "2",
    ]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as running:
        wait_until(
            lambda: (
                running.poll() is not None
                or len(list((out / RECORDS).glob("*.json"))) >= 3
            ),
            "three records",
        )
        running.send_signal(signal.SIGKILL)
    assert running.returncode == -signal.SIGKILL
    assert batch(bags, "-o", out, "--workers", 2) == 0
    told = content(out)
    assert 3 <= told["done_before"] < 12 and told["qualified"] == 12
    names = [
        path.name for part in (RECORDS, RESULTS) for path in (out / part).iterdir()
    ]
    assert len(names) == 24 and not any(name.startswith(".selfcal") for name in names)


def test_two_batches_do_not_work_in_one_folder(shelf, tmp_path, capsys):
    with opened(tmp_path / "out"):
        assert batch(shelf / "a.mcap", "-o", tmp_path / "out") == 2
    assert capsys.readouterr().err == (
        f"selfcal batch: {tmp_path / 'out'}: another batch works in "
        "this folder; wait for it to end or name another folder\n"
    )


def test_a_folder_that_cannot_be_written_is_one_line(shelf, tmp_path, capfd):
    """As on a full disk: it is the folder that fails, not a bag."""
    (tmp_path / RESULTS).symlink_to("/proc")
    assert (
        batch(shelf / "a.mcap", shelf / "b.mcap", "-o", tmp_path, "--workers", 2) == 2
    )
    [line] = capfd.readouterr().err.splitlines()
    assert f"{tmp_path / RESULTS}" in line and "cannot be written (" in line


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--workers", "0"], "--workers: 0 is not a number of workers; give 1 to 1024"),
        (
            ["--dask", "x.mcap"],
            "--dask: 'x.mcap' is not the address of a scheduler; write HOST:PORT, "
            "or --dask local in front of a bag",
        ),
    ],
)
def test_options_that_cannot_be(shelf, tmp_path, capsys, options, message):
    assert batch(shelf / "a.mcap", "-o", tmp_path / "out", *options) == 2
    assert capsys.readouterr().err == f"selfcal batch: {message}\n"


def test_a_bag_is_no_folder_for_results(tmp_path, capsys):
    bag = Path(__file__).parents[3] / "bags" / "hu_exact"
    for folder in (bag, bag / "results"):
        assert batch(bag, "-o", folder) == 2
        assert capsys.readouterr().err == (
            f"selfcal batch: {folder}: it is in the bag {bag}; name another folder\n"
        )
    assert {path.suffix for path in bag.iterdir()} == {".mcap", ".yaml", ".json"}


def test_bags_are_found_at_any_depth_once(shelf, tmp_path):
    names = [
        "a.mcap",
        "b.mcap",
        "deep/c.mcap",
        "deep/deeper/d.mcap",
        "few.mcap",
        "text.mcap",
    ]
    assert find_bags([str(shelf), str(shelf / "a.mcap")]) == [
        shelf / name for name in names
    ]
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").touch()
    (tmp_path / "bag" / "part_0.mcap").touch()
    (tmp_path / ".trash").mkdir()
    (tmp_path / ".trash" / "old.mcap").touch()
    assert find_bags([str(tmp_path)]) == [tmp_path / "bag"]
    with pytest.raises(InputError) as caught:
        find_bags([str(tmp_path / "none")])
    assert (
        str(caught.value)
        == f"{tmp_path / 'none'}: no such file or folder; check the path"
    )
    with pytest.raises(NoDataError) as nothing:
        find_bags([str(_empty(tmp_path))])
    assert str(nothing.value).startswith(
        f"{tmp_path / 'empty'}: no bag in it; give MCAP files"
    )


@pytest.fixture
def top(tmp_path):
    """A folder that may become deeper than Python can remove."""
    (tmp_path / "top").mkdir()
    yield tmp_path / "top"
    subprocess.run(["rm", "-r", str(tmp_path / "top")], check=True)


def test_bags_are_found_below_1500_folders_and_links_to_themselves_are_passed(
    shelf, top, tmp_path, monkeypatch, capsys
):
    with monkeypatch.context() as here:
        here.chdir(top)
        for _ in range(1500):
            os.mkdir("d")
            here.chdir("d")
        shutil.copy(shelf / "a.mcap", os.fsdecode(b"n\xff.mcap"))
    (top / "self.mcap").symlink_to("self.mcap")
    (top / "here").symlink_to(".")
    out = tmp_path / "out"
    assert batch(top, "-o", out, "--workers", 1) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "self.mcap: cannot be read (Too many levels of symbolic links)" in line
    assert {record["exit_code"] for record in content(out)["records"]} == {0, 2}
    assert "n\\udcff.mcap" in (out / "table.csv").read_text()
    assert "udcff.mcap" in (out / "index.html").read_text()


@pytest.mark.parametrize(
    ("codes", "code"),
    [
        ((), 0),
        ((0, 0), 0),
        ((0, 5), 5),
        ((5, 0, 4), 4),
        ((4, 3, 5), 3),
        ((5, 2, 3), 2),
        ((2, 1), 1),
    ],
)
def test_the_worst_bag_gives_the_exit_code(codes, code):
    assert exit_code([{"exit_code": one} for one in codes]) == code


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def records(number: int = 30, change: int = 18, **more) -> list[dict]:
    """Return records of one plan, a day apart, whose squareness steps by 1 arcsec."""
    values = np.random.default_rng(2).normal(0, 0.1, number) + (
        np.arange(number) >= change
    )
    return [
        {
            "bag": f"/bags/{day:02}",
            "exit_code": 0,
            "qualified": True,
            "message": "Qualified",
            "plan_id": "p",
            "plate": [5, 5, 0.01, 8],
            "sha256": str(day),
            "run_id": "",
            "first_exposure": f"2026-03-{day + 1:02}T12:00:00.000+00:00",
            "quantities": {"nonorthogonality_arcsec": value, "sigma_xy_um": None},
            **more,
        }
        for day, value in enumerate(values)
    ]


def test_a_change_is_named_between_bags_in_which_the_quantity_is_known():
    gap = records()
    for record in gap[14:18]:
        record["quantities"]["nonorthogonality_arcsec"] = None
    (series,) = series_of(gap)
    (line,) = series.sentences()
    assert line.startswith(
        "nonorthogonality: changed between 2026-03-14 12:00 and 2026-03-19 "
    )
    found = batch_json(gap, [series], 0)["series"][0]["courses"][
        "nonorthogonality_arcsec"
    ]
    assert [day[:10] for day in found["change_between"]] == ["2026-03-14", "2026-03-19"]
    # the dashed line: half way from day 13 to day 18 of 29
    place = 64 + (560 - 64 - 14) * 15.5 / 29
    assert f'class="s-bad" d="M{place:.1f} ' in page_html(gap, [series], ["30 bags"])
    steady = [
        record | {"quantities": {"x_um": 1.0 if day > 4 else None}}
        for day, record in enumerate(records())
    ]
    (series,) = series_of(steady)
    (course,) = batch_json(steady, [series], 0)["series"][0]["courses"].values()
    assert course["finding"] == "none" and course["change_between"] is None


def test_a_change_is_named_with_its_date_whatever_the_order_of_the_bags():
    shuffled = (
        np.random.default_rng(4).permutation(np.array(records(), dtype=object)).tolist()
    )
    (series,) = series_of(shuffled)
    (line,) = series.sentences()
    assert line.startswith(
        "nonorthogonality: changed between 2026-03-18 12:00 and 2026-03-19 12:00 by +1"
    )
    head, plan, said = summary_lines(shuffled, [series], 4)
    assert head == (
        "30 bags: 30 calibrated, 30 of them qualified, 0 without a result; 4 were done before"
    )
    assert plan == "plan p, 30 bags from 2026-03-01 12:00 to 2026-03-30 12:00:"
    assert said == f"  {line}"


def test_plans_and_plates_are_not_mixed():
    other = records(plan_id="q") + records(plate=[7, 7, 0.01, 8])
    assert [len(series.records) for series in series_of(records() + other)] == [
        30,
        30,
        30,
    ]
    assert series_of([record | {"first_exposure": None} for record in records()]) == []


def test_no_name_in_the_table_is_a_formula():
    record = records()[0] | {"bag": "=1+1", "plan_id": "-2", "message": "@x"}
    record["causes"] = [{"name": "drift", "view": "+cmd|' /C calc'!A0"}]
    record["quantities"] = {"nonorthogonality_arcsec": -0.5}
    (row,) = csv.DictReader(io.StringIO(csv_text([record])))
    assert (row["bag"], row["plan_id"], row["message"]) == ("'=1+1", "'-2", "'@x")
    assert row["cause_view"] == "'+cmd|' /C calc'!A0"
    assert row["nonorthogonality_arcsec"] == "-0.5"


def test_the_table_has_a_line_a_bag_in_the_order_of_time():
    failed = {
        "bag": '/bags/bad, or "worse"',
        "exit_code": 2,
        "qualified": None,
        "message": "no",
    }
    known = records()
    known[1] |= {
        "causes": [{"name": "drift", "view": "run 2: shift x"}, {"name": "slip"}]
    }
    rows = list(csv.DictReader(io.StringIO(csv_text([failed, *known[::-1]]))))
    assert [(row["cause"], row["cause_view"]) for row in rows[:3]] == [
        ("", ""),
        ("drift", "run 2: shift x"),
        ("", ""),
    ]
    assert [row["bag"] for row in rows] == [f"/bags/{day:02}" for day in range(30)] + [
        failed["bag"]
    ]
    assert (rows[0]["qualified"], rows[0]["sigma_xy_um"], rows[30]["qualified"]) == (
        "true",
        "",
        "",
    )
    assert float(rows[0]["nonorthogonality_arcsec"]) == pytest.approx(
        records()[0]["quantities"]["nonorthogonality_arcsec"], rel=1e-15
    )


class Page(html.parser.HTMLParser):
    """Tags that are open, and how often each came."""

    VOID = ("meta", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.seen = [], {}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.seen[tag] = self.seen.get(tag, 0) + 1
        assert not any(
            name.startswith("on") or name in ("src", "href") for name, _ in attrs
        )
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_asks_for_nothing_and_shows_what_is_named():
    found = records(plan_id="<script>alert(1)</script>\x1b[31m")
    series = series_of(found)
    page = Page(text := page_html(found, series, summary_lines(found, series, 0)))
    assert page.open == [] and "script" not in page.seen and "\x1b" not in text
    assert page.seen["tr"] == 31 and page.seen["circle"] == 30
    assert text.count('class="s-bad" d=') == 1 and text.count('class="s-ink" d=') == 2


def test_names_of_quantities_in_words():
    assert described("nonorthogonality_arcsec") == ("nonorthogonality", "arcsec")
    assert described("max_error_um") == ("max error", "µm")
    assert described("rejected_percent") == ("rejected", "%")
    assert described("microscope_scale_m_per_m") == ("microscope scale", "m/m")


def test_quantities_with_an_uncertainty_have_bars_and_no_course_of_it():
    found = records()
    plain = page_html(found, series_of(found), [""])
    for record in found:
        record["quantities"] = record["quantities"] | {
            "u_nonorthogonality_arcsec": 0.01
        }
    series = series_of(found)
    assert "nonorthogonality_arcsec" in series[0].courses
    assert "u_nonorthogonality_arcsec" not in series[0].courses
    text = page_html(found, series, [""])
    assert "(u is not known)" in plain and "(u is not known)" not in text
    assert text.count('class="s-soft" d=') == plain.count('class="s-soft" d=') + 30
    assert re.search(r"<td [^>]*>-?\d\.\d{3} ± 0\.020</td>", text)


def test_plots_of_one_kind_share_a_scale_and_few_come_first():
    found = records()
    for day, record in enumerate(found):
        record["quantities"] |= {
            "max_error_um": 0.7 + 0.01 * (day % 3),
            "rms_error_um": 0.2,
            "rms_uncertainty_um": 0.01,
            "sigma_xy_um": 0.02,
        }
    (series,) = series_of(found)
    spans = _common_spans(series)
    assert spans["max_error_um"] == spans["rms_error_um"] != spans["sigma_xy_um"]
    low, high = spans["max_error_um"]
    assert low < 0.2 and high > 0.72 + 2 * 0.01
    text = page_html(found, [series], [""])
    first, more = text.split("<details>")
    assert first.count("<figure>") == 2 and "2 further quantities" not in first
    assert re.match(r"<summary>(\d) further quantities", more)[1] == str(
        more.count("<figure>")
    )
    head = re.search(r"<thead><tr>(.*?)</tr>", text)[1]
    assert re.findall(r"<th[^>]*>(.*?)</th>", head) == [
        "bag",
        "first exposure",
        "verdict",
        "max error, µm",
        "nonorthogonality, arcsec",
    ]


def test_limits_are_three_robust_standard_deviations_about_the_median():
    values = np.random.default_rng(5).normal(7.0, 0.1, 4001)
    values[:40] = 1e6
    low, high = _limits(values)
    assert low == pytest.approx(6.7, abs=0.03) and high == pytest.approx(7.3, abs=0.03)


def test_the_share_of_rejected_detections_is_of_all_that_were_read():
    plan, rng = hu_plan(Artifact(5, 0.01, 0)), np.random.default_rng(1)
    readings = simulate_measurements(
        random_truth(plan.artifact, 4, rng), plan, rng, sigma_m=2e-8
    )
    result = calibrate(readings, bare(causes=False))
    used = sum(view.used for view in result.views)
    assert used == 25 + 25 + 20
    for rejected in ({}, {"late": 3, "outlier": 7}, {"late": 70}):
        number = sum(rejected.values())
        found = jobs.quantities(replace(result, rejected=rejected))["rejected_percent"]
        assert found == pytest.approx(100 * number / (used + number))

# SPDX-License-Identifier: Apache-2.0
"""The bench runs, skips with a reason, and writes what the contract says."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from selfcal_ros.errors import InputError

RUN = Path(__file__).with_name("run.py")
KEYS = {"benchmark", "method", "n", "seconds", "peak_mb", "max_error"}
OF_THEIR_OWN = ("selfcal", "mcap (not decoded)")
"""Methods whose processes are real here, too."""


@pytest.fixture
def bench(tmp_path, monkeypatch, capsys):
    """Return the bench as a call; most workers run in this process, once instead of for 0.5 s."""
    monkeypatch.syspath_prepend(RUN.parent)
    run, ingest, timing = map(importlib.import_module, ("run", "ingest", "timing"))
    monkeypatch.setattr(timing, "MIN_SECONDS", 0.0)
    monkeypatch.setattr(run.resource, "setrlimit", lambda *_: None)
    start = subprocess.run

    def begun(command, **how):
        if command[1] != run.__file__ or command[4] in OF_THEIR_OWN:
            return start(command, **how)
        kind, benchmark, method, last = command[2:]
        row = (
            run.worker(benchmark, method, int(last))
            if kind == "--worker"
            else ingest.worker(benchmark, method, Path(last))
        )
        return subprocess.CompletedProcess(command, 0, json.dumps(row), "")

    def measured(*args):
        target = tmp_path / "bench.json"
        monkeypatch.setattr(
            sys,
            "argv",
            [str(RUN), "-o", str(target), "--compensate", "0", "--images", "0", *args],
        )
        assert run.main() == 0
        return capsys.readouterr().out, json.loads(target.read_text())

    monkeypatch.setattr(subprocess, "run", begun)
    return measured


def test_every_method_is_measured_and_exact(bench):
    out, rows = bench("--sizes", "7", "--ingest", "0", "--detections", "0")
    methods = {row["method"] for row in rows}
    assert {
        "selfcal",
        "numpy.linalg.lstsq",
        "scipy lsmr",
        "scipy splu",
        "gtsam",
        "pyceres",
    } <= methods
    assert {row["benchmark"] for row in rows} == {
        "solve",
        "without noise",
        "re-solve",
        "uncertainty",
        "missing",
        "five views",
        "terms",
        "general",
    }
    ours = next(row["max_error"] for row in rows if row["benchmark"] == "solve")
    for row in rows:
        assert row.keys() >= KEYS and row["n"] == 7
        assert row["method"] in out
        if row["seconds"] is None:
            assert row["note"] == "not installed" and row["method"] in (
                "gtsam",
                "pyceres",
            )
        else:
            assert row["seconds"] > 0 and row["peak_mb"] > 10
            if row["benchmark"] in ("without noise", "general"):
                assert row["max_error"] < (
                    1e-9 if row["method"] == "pyceres" else 1e-12
                )
            elif row["benchmark"] == "solve":  # one minimum for all
                assert row["max_error"] == pytest.approx(ours, rel=0.01)


def test_unknown_methods_are_refused(bench, tmp_path):
    with pytest.raises(
        InputError, match=r"^--methods: 'magic' is unknown; see --help$"
    ):
        bench("--methods", "magic")
    assert not (tmp_path / "bench.json").exists()


def test_every_way_to_read_meets_every_message(bench):
    out, rows = bench("--sizes", "", "--ingest", "20000", "--detections", "5000")
    by_method = {row["method"]: row for row in rows}
    assert {row["benchmark"] for row in rows} == {"ingest", "ingest detections"}
    assert by_method.keys() == {
        "selfcal solve",
        "selfcal (columns)",
        "selfcal (reading)",
        "selfcal (solving)",
        "rosbags",
        "mcap (not decoded)",
        "mcap-ros2-support",
        "pybag-sdk",
    }
    for method, row in by_method.items():
        assert row.keys() >= KEYS and method in out
        if row["seconds"] is None:
            assert row["note"] == "not installed" and method in (
                "mcap-ros2-support",
                "pybag-sdk",
            )
            continue
        assert row["seconds"] > 0 and row["peak_mb"] > 10 and row["n"] > 5000
        assert row["cpu_seconds"] > 0 and f"{row['cpu_seconds']:.2f}" in out
        exact = method in ("selfcal solve", "selfcal (solving)")
        assert (row["max_error"] < 1e-12) if exact else row["max_error"] is None


def test_processor_time_counts_what_the_process_and_its_children_do(monkeypatch):
    monkeypatch.syspath_prepend(RUN.parent)
    ingest = importlib.import_module("ingest")
    work = "import time\nwhile time.process_time() < 0.05: pass"
    taken, done = ingest.timed(
        lambda: subprocess.run([sys.executable, "-c", work], check=True)
    )
    assert done.returncode == 0 and taken.cpu_s >= 0.05


def test_without_ros_compensators_are_left_out_with_a_reason(bench, monkeypatch):
    monkeypatch.setattr(sys.modules["run"], "find_spec", lambda name: None)
    _, rows = bench(
        "--sizes", "", "--ingest", "0", "--detections", "0", "--compensate", "2"
    )
    assert [(row["benchmark"], row["n"], row["note"]) for row in rows[::2]] == [
        (f"compensate {rate} Hz", 2 * rate, "not installed")
        for rate in (500, 1000, 2000, 10000, 2000)
    ]
    assert rows[-1]["method"] == "selfcal, by strangers"
    assert all(row.keys() >= KEYS for row in rows)


def test_marks_are_found_at_the_bound(bench, monkeypatch):
    """Two images: 36 errors a row, so their rms is within 4 sigma of the bound, or 47 % of it."""
    detecting = importlib.import_module("detecting")
    monkeypatch.setattr(detecting, "RATIOS", (50,))
    monkeypatch.setattr(detecting, "MANY", (5,))
    out, rows = bench(
        "--sizes", "", "--ingest", "0", "--detections", "0", "--images", "2"
    )
    assert [row["benchmark"] for row in rows if row["method"] == "selfcal"] == [
        *(f"detect {mark} 50" for mark in ("disc", "ring", "cross", "corner")),
        "detect many",
    ]
    for row in rows:
        if row["benchmark"] == "detect many":
            assert row["seconds"] is None or row["found"] == 1.0
        elif row["method"] == "selfcal":
            assert row["found"] == 1.0 and 0.53 < row["rms_px"] / row["bound_px"] < 1.47
            assert row["max_error"] < 0.05 * 2e-6
        else:
            assert row["seconds"] is not None or row["note"] == "not installed"
        assert row.keys() >= KEYS and row["benchmark"] in out

# SPDX-License-Identifier: Apache-2.0
"""The bench runs, skips with a reason, and writes what the contract says."""

import json
import subprocess
import sys
from pathlib import Path

RUN = Path(__file__).with_name("run.py")
KEYS = {"benchmark", "method", "n", "seconds", "peak_mb", "max_error"}


def bench(tmp_path, *args):
    target = tmp_path / "bench.json"
    done = subprocess.run([sys.executable, str(RUN), "-o", str(target), *args], text=True,
                          capture_output=True, check=False)
    return done, json.loads(target.read_text()) if target.exists() else None


def test_every_method_is_measured_and_exact(tmp_path):
    done, rows = bench(tmp_path, "--sizes", "7", "--ingest", "0", "--detections", "0")
    assert done.returncode == 0, done.stderr
    methods = {row["method"] for row in rows}
    assert {"selfcal", "numpy.linalg.lstsq", "scipy lsmr", "scipy splu", "gtsam",
            "pyceres"} <= methods
    assert {row["benchmark"] for row in rows} == {"solve", "re-solve", "map only", "uncertainty",
                                                "missing", "five views", "terms"}
    for row in rows:
        assert row.keys() >= KEYS and row["n"] == 7
        assert row["method"] in done.stdout
        if row["seconds"] is None:
            assert row["note"] == "not installed" and row["method"] in ("gtsam", "pyceres")
        else:
            assert row["seconds"] > 0 and row["peak_mb"] > 10
            noisy = row["benchmark"] in ("five views", "terms")
            assert noisy or row["max_error"] < (1e-9 if row["method"] == "pyceres" else 1e-12)


def test_unknown_methods_are_refused(tmp_path):
    done, rows = bench(tmp_path, "--methods", "magic")
    assert done.returncode != 0 and rows is None
    assert "--methods: 'magic' is unknown" in done.stderr


def test_every_way_to_read_meets_every_message(tmp_path):
    done, rows = bench(tmp_path, "--sizes", "", "--ingest", "20000", "--detections", "5000")
    assert done.returncode == 0, done.stderr
    by_method = {row["method"]: row for row in rows}
    assert {row["benchmark"] for row in rows} == {"ingest", "ingest detections"}
    assert by_method.keys() == {
        "selfcal solve", "selfcal (columns)", "selfcal (reading)", "selfcal (solving)", "rosbags",
        "mcap (not decoded)", "mcap-ros2-support", "pybag-sdk"}
    for method, row in by_method.items():
        assert row.keys() >= KEYS and method in done.stdout
        if row["seconds"] is None:
            assert row["note"] == "not installed" and method in ("mcap-ros2-support", "pybag-sdk")
            continue
        assert row["seconds"] > 0 and row["peak_mb"] > 10 and row["n"] > 5000
        exact = method in ("selfcal solve", "selfcal (solving)")
        assert (row["max_error"] < 1e-12) if exact else row["max_error"] is None

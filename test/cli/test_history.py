# SPDX-License-Identifier: Apache-2.0
"""``selfcal history``: a folder of calibrations, its active map, changes and drift."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.verdict import Grade
from selfcal_ros.nodes.sessions.compensating import CompensatingSession
from selfcal_ros.outputs import write_json
from selfcal_ros.results import read_result
from test.support.ports import Hands, settings_of
from test.support.truth import hu_plan, random_truth, simulate_measurements

BEGAN = datetime(2026, 3, 1, 8, tzinfo=UTC)
ARTIFACT = Artifact(5, 0.01, 8)


def write(path, *, day=0, bow_m=0.0, noise_m=1e-9, **changes):
    """Write a calibration of a stage, some days later and bent by so much."""
    truth = random_truth(ARTIFACT, 4, np.random.default_rng(1))
    bow = bow_m * (ARTIFACT.m / 2.0) ** 2 - bow_m * 0.5
    truth = replace(truth, g=truth.g + np.stack([0 * bow, bow]))
    readings = simulate_measurements(
        truth,
        hu_plan(ARTIFACT),
        np.random.default_rng(day + 5),
        sigma_m=noise_m,
        sigma_theta_rad=1e-6,
    )
    result = calibrate(readings, Options())
    when = (BEGAN + timedelta(days=day)).isoformat()
    times = replace(result.provenance, first_exposure=when, last_exposure=when)
    result = replace(result, provenance=times, **changes)
    write_json(path, result_to_dict(result))
    return path


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "stage"
    path.mkdir()
    return path


def told(folder, capsys):
    assert main(["history", str(folder), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_calibrations_are_listed_in_the_order_of_their_measurement(folder, capsys):
    (folder / "results").mkdir()  # as of a batch
    write(folder / "a.json", day=9, bow_m=4e-7)
    write(folder / "results" / "b.json", day=2)
    (folder / "batch.json").write_text('{"schema": "selfcal.batch/1"}')
    (folder / "notes.json").write_text("not JSON")
    found = told(folder, capsys)
    assert [entry["file"] for entry in found["entries"]] == [
        str(folder / "results" / "b.json"),
        str(folder / "a.json"),
    ]
    first, second = found["entries"]
    emap = read_result(str(folder / "a.json")).error_map
    assert second["largest_m"] == np.hypot(emap.gx, emap.gy).max()
    assert first["not_compared"] is None and found["active"] is None
    assert second["changed"]
    # nothing but a shift is removed from it
    bow = 4e-7 * ((ARTIFACT.m / 2.0) ** 2 - 0.5)
    assert second["change_rms_m"] == pytest.approx(
        np.sqrt(np.mean(bow**2) / 2), rel=0.02
    )
    assert second["change_max_m"] == pytest.approx(np.abs(bow).max(), rel=0.02)
    # each map has 5 nm of bending in its u; with nothing else it is 1.414 times 5 nm and more
    assert 7e-9 < second["u_change_rms_m"] < 1.4e-8


def test_the_next_is_due_when_the_drift_reaches_u(folder, capsys):
    write(folder / "a.json", noise_m=2e-8)
    for day in (4, 8, 12):
        write(folder / f"{day}.json", day=day, bow_m=day * 2e-8)
    assert main(["history", str(folder), "--activate", "a.json"]) == 0
    text = capsys.readouterr().out
    assert "* 2026-03-01 08:00  calibration" in text
    assert len(text.splitlines()[0]) <= 80
    found = told(folder, capsys)
    drift = found["drift"]
    result = read_result(folder / "a.json")
    emap = result.error_map
    limit = result.noise.k_xy * np.sqrt(np.mean([emap.u_gx**2, emap.u_gy**2]))
    assert drift["limit_m"] == pytest.approx(limit)
    per_day = 2e-8 * np.sqrt(np.mean(((ARTIFACT.m / 2.0) ** 2 - 0.5) ** 2) / 2)
    assert drift["clear"] and drift["per_day_m"] == pytest.approx(per_day, rel=0.2)
    due = datetime.fromisoformat(drift["due"])
    assert (due - BEGAN).total_seconds() / 86400 == pytest.approx(
        limit / drift["per_day_m"], abs=1e-3
    )


def test_a_mean_is_of_the_middle_of_its_runs_which_are_no_checks_of_it(folder, capsys):
    """Active: the drift is that of the later check alone, from the middle on."""
    for day in (0, 8, 24):
        write(
            folder / f"{day}.json",
            day=day,
            bow_m=day * 2e-8,
            noise_m=2e-8,
            input={"file": "bag", "sha256": f"{day:064x}"},
        )
    runs = [str(folder / f"{day}.json") for day in (0, 8)]
    assert main(["combine", *runs, "-o", str(folder / "mean.json")]) == 0
    assert main(["history", str(folder), "--activate", "mean.json"]) == 0
    capsys.readouterr()
    found = told(folder, capsys)
    assert [entry["kind"] for entry in found["entries"]] == [
        "calibration",
        "mean",
        "calibration",
        "calibration",
    ]
    _, mean, second, _ = found["entries"]
    assert mean["measured"].startswith("2026-03-05T08:00")
    assert mean["not_compared"] == "a mean and one of its runs"
    assert second["change_rms_m"] > 0  # from the calibration before the mean
    per_day = 2e-8 * np.sqrt(np.mean(((ARTIFACT.m / 2.0) ** 2 - 0.5) ** 2) / 2)
    assert found["drift"]["per_day_m"] == pytest.approx(per_day, rel=0.2)


def test_without_drift_it_is_not_due_before_one_could_have_been_missed(folder, capsys):
    write(folder / "a.json", noise_m=2e-8)
    write(folder / "b.json", day=10, noise_m=2e-8)
    assert main(["history", str(folder), "--activate", str(folder / "a.json")]) == 0
    said = capsys.readouterr().out
    assert "none that is clear" in said and "it does not reach U, " in said
    drift = told(folder, capsys)["drift"]
    assert not drift["clear"] and not drift["too_coarse"]
    missed = np.hypot(drift["per_day_m"], 2 * drift["u_per_day_m"])
    days = (datetime.fromisoformat(drift["due"]) - BEGAN).total_seconds() / 86400
    assert days == pytest.approx(drift["limit_m"] / missed, abs=1e-3)
    assert days >= 10


def test_checks_that_are_too_coarse_for_u_give_no_date(folder, capsys):
    write(folder / "a.json", noise_m=1e-8)
    for day in (10, 20):
        write(folder / f"{day}.json", day=day, noise_m=5e-8)
    assert main(["history", str(folder), "--activate", "a.json"]) == 0
    said = capsys.readouterr().out
    assert "until 2026-03-21 08:00 a drift of U, " in said
    assert "recheck with more views and repeats" in said and " due " not in said
    drift = told(folder, capsys)["drift"]
    assert drift["too_coarse"] and drift["due"] is None
    assert datetime.fromisoformat(drift["checked"]) == BEGAN + timedelta(days=20)
    write(folder / "fine.json", day=20, noise_m=1e-8)
    drift = told(folder, capsys)["drift"]
    assert drift["due"] >= drift["checked"]


def test_a_coarse_check_hides_no_drift_and_none_is_due_before_it(folder, capsys):
    write(folder / "a.json", noise_m=1e-8)
    for day in (4, 8):
        write(folder / f"{day}.json", day=day, bow_m=day * 2e-8, noise_m=1e-8)
    write(folder / "coarse.json", day=12, noise_m=1e-6)
    assert main(["history", str(folder), "--activate", "a.json"]) == 0
    assert "calibrate by then" in capsys.readouterr().out
    found = told(folder, capsys)
    assert found["entries"][-1]["changed"] is False
    assert found["drift"]["clear"]
    assert found["drift"]["due"] == found["drift"]["checked"]


def test_the_part_beyond_noise_has_the_u_that_it_scatters_by():
    """Of unchanged stages two u are exceeded seldom, and u describes the scatter."""
    truth = random_truth(ARTIFACT, 4, np.random.default_rng(1))
    first, *later = (
        calibrate(
            simulate_measurements(
                truth,
                hu_plan(ARTIFACT),
                np.random.default_rng(seed),
                sigma_m=2e-8,
                sigma_theta_rad=1e-6,
            ),
            Options(),
        )
        for seed in range(21)
    )
    changes = [
        compare(one, other) for one, other in zip([first, *later], later, strict=False)
    ]
    squares = [change.rms_m**2 - change.xy.u_rms**2 for change in changes]
    u = np.mean([change.u_beyond_m**2 for change in changes])
    assert np.std(squares) == pytest.approx(u, rel=0.5)
    assert all(change.beyond_m < 2 * change.u_beyond_m for change in changes)


def test_the_folder_stands_for_its_active_map(folder, capsys, tmp_path):
    write(folder / "a.json")
    write(folder / "b.json", day=3, bow_m=3e-7)
    points = tmp_path / "points.csv"
    points.write_text("x,y\n0.02,0.0\n")
    for name, source in (("a.json", "old.csv"), ("b.json", "new.csv")):
        assert main(["history", str(folder), "--activate", name]) == 0
        assert (
            main(["apply", str(folder), str(points), "-o", str(tmp_path / source)]) == 0
        )
        hands = Hands()
        CompensatingSession(settings_of("compensator", map=str(folder)), hands.ports)
        assert any(name in str(said) for said in hands.said)
    assert (tmp_path / "old.csv").read_text() != (tmp_path / "new.csv").read_text()


def test_a_result_of_the_folder_is_active_beside_its_original(
    folder, tmp_path, capsys, monkeypatch
):
    """`solve -o a.json`, `cp a.json FOLDER`, `history FOLDER --activate a.json`."""
    write(tmp_path / "a.json")
    write(folder / "a.json")
    monkeypatch.chdir(tmp_path)
    assert main(["history", str(folder), "--activate", "a.json"]) == 0
    assert "active (*): a.json" in capsys.readouterr().out


def test_another_plate_is_not_compared(folder, capsys):
    write(folder / "a.json")
    other = read_result(folder / "a.json")
    artifact = replace(ARTIFACT, grid_pitch_m=0.02)
    write(
        folder / "b.json", day=1, error_map=replace(other.error_map, artifact=artifact)
    )
    assert "pitches of" in told(folder, capsys)["entries"][1]["not_compared"]


def test_what_cannot_be_is_refused_in_a_line(folder, tmp_path, capsys):
    def refused(*arguments, code=2):
        assert main(["history", *map(str, arguments)]) == code
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        return err

    assert "no RESULT.json with a map is in it" in refused(folder, code=4)
    write(folder / "a.json")
    bad = write(folder / "bad.json", day=1)
    result = read_result(bad)
    write_json(
        bad,
        result_to_dict(
            replace(result, verdict=replace(result.verdict, grade=Grade.NOT_QUALIFIED))
        ),
    )
    assert "is not qualified" in refused(folder, "--activate", "bad.json")
    assert "no such file" in refused(folder, "--activate", "c.json")
    (folder / "map").write_bytes((folder / "a.json").read_bytes())
    assert "end the name in .json" in refused(folder, "--activate", "map")
    outside = write(tmp_path / "c.json")
    assert "copy it there first" in refused(folder, "--activate", outside)
    assert "is not a folder" in refused(outside)
    assert not (folder / "active").exists()
    assert main(["plot", str(folder), "-o", str(tmp_path / "m.svg")]) == 2
    assert f"selfcal history {folder} --activate" in capsys.readouterr().err
    (folder / "active").write_text("gone.json\n")
    assert "names 'gone.json', which is not there" in refused(folder)

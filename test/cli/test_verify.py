# SPDX-License-Identifier: Apache-2.0
"""``selfcal verify``: what the correction does in the machine, from a bag."""

import json

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.cli.main import main
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.nodes.sessions.solving import SolvingSession, solve
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.ports import Hands, message, settings_of
from test.support.verbs import simulate

PLATE = {"grid_size": 7, "grid_pitch": 0.01, "angular_count": 8}
VIEWS = [
    {"name": "identity"},
    {"name": "rot90", "rotation_deg": 90},
    {"name": "line", "rotation_deg": 45, "grid": False},
    {"name": "shift_x", "translation_pitch": [1, 0]},
]
MACHINE = {
    "seed": 3,
    "truth": {"phi": 1e-4, "t": 1e-5, "correlation": 3},
    "noise": {"sigma_xy": 2e-8, "sigma_theta": 2e-6},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A calibration: r.json of the bag first."""
    folder = tmp_path_factory.mktemp("verify")
    simulate(
        folder,
        "first",
        {"plan_id": "first", "artifact": PLATE, "views": VIEWS},
        noise_seed=1,
        **MACHINE,
    )
    assert (
        main(["solve", str(folder / "first"), "-o", str(folder / "r.json"), "--quiet"])
        == 0
    )
    return folder


def verified(folder, capsys, name, times, views, *more):
    """Return exit code and JSON of a machine whose table acts `times`."""
    simulate(
        folder,
        name,
        {"plan_id": name, "artifact": PLATE, "views": views},
        noise_seed=2,
        correction={"result": "r.json", "times": times},
        **MACHINE,
    )
    capsys.readouterr()
    code = main(["verify", str(folder / "r.json"), str(folder / name), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("views", "times", "fault", "code"),
    [
        (VIEWS, -1, "sign", 5),
        (VIEWS, 25.4, "factor", 5),
        (VIEWS[:1], 1, "none", 0),
        (VIEWS[:1], -1, "sign", 5),
        (VIEWS[:1], 0, "off", 5),
        (VIEWS[:1], 0.4, "factor", 5),
    ],
)
def test_what_acts_is_named(folder, capsys, views, times, fault, code):
    name = f"act_{times}_{len(views)}"
    found_code, found = verified(folder, capsys, name, times, views)
    assert (found_code, found["fault"]) == (code, fault)
    assert found["passed"] is (code == 0)
    assert found["better"] is (0 < times < 2)
    for axis in found["axes"].values():
        assert abs(axis["factor"] - times) < max(
            5 * axis["u_factor"], 0.002 * abs(times)
        )


def test_a_correction_that_acts(folder, capsys):
    """The remaining error is that of the calibration's noise, within U."""
    picture = folder / "right.png"
    code, found = verified(folder, capsys, "right", 1, VIEWS, "--plot", str(picture))
    x = found["axes"]["x"]
    assert code == 0 and x["rms_after"] < x["rms_before"] / 5
    assert x["rms_after"] < x["U_before"] + x["U_after"]
    assert x["rms_after"] == pytest.approx(np.sqrt(np.mean(np.square(found["gx"]))))
    assert picture.stat().st_size > 10_000
    assert main(["verify", str(folder / "r.json"), str(folder / "right")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("Better: the error is ")
    assert "the correction acts as the map says" in text
    table = text.split("\n\n")[1].splitlines()
    assert len(table) == 8 and max(map(len, table)) <= 80
    assert "θ, arcsec" in text


def test_the_calibrations_own_recording_is_refused(folder, capsys):
    assert main(["verify", str(folder / "r.json"), str(folder / "first")]) == 2
    assert "measure again with the correction on" in capsys.readouterr().err


def test_a_map_of_another_lattice_is_refused(folder, capsys):
    simulate(
        folder,
        "small",
        {"plan_id": "small", "artifact": PLATE | {"grid_size": 5}, "views": VIEWS},
        noise_seed=2,
        **MACHINE,
    )
    assert main(["verify", str(folder / "r.json"), str(folder / "small")]) == 2
    assert "the lattices differ: (7, 7) and (5, 5) sites" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("views", "times", "passed"),
    [(VIEWS, 1, True), (VIEWS[:1], 1, True), (VIEWS[:1], -1, False)],
)
def test_a_plan_that_verifies_says_the_same_live(folder, capsys, views, times, passed):
    name = f"live_{times}_{len(views)}"
    plan = {
        "plan_id": name,
        "verify": str(folder / "r.json"),
        "artifact": PLATE,
        "views": views,
    }
    simulate(
        folder,
        name,
        plan,
        noise_seed=2,
        correction={"result": "r.json", "times": times},
        **MACHINE,
    )
    capsys.readouterr()
    assert main(
        ["verify", str(folder / "r.json"), str(folder / name), "--json"]
    ) == 5 * (not passed)
    told = json.loads(capsys.readouterr().out)["sentence"]

    hands = Hands()
    session = SolvingSession(settings_of("solver"), hands.ports)
    measurements, progress, *_ = collect_bag(
        str(folder / name), CollectorSettings.checked({}, "")
    )
    first = progress[0].readings.view
    planned = Command(
        int(measurements.run_id),
        Phase.MEASURE,
        name,
        0,
        first,
        measurements.artifact,
        len(views),
        measurements.run_id,
    )
    session.take_command(message("ViewCommand", from_model.command(planned, "stage")))
    for index, view in progress.items():
        session.take_measurement(
            message(
                "ViewMeasurement",
                from_model.view_measurement(view, measurements, 10 + index, "stage"),
            )
        )
        job = session.next_job()
        assert (job is None) is (index < len(views) - 1)  # it waits for the last view
    session.take(solve(job))
    summaries = [fields for output, fields in hands.published if output == "summary"]
    assert summaries[-1]["state"] == told
    assert summaries[-1]["qualified"] is passed
    # nobody corrects by what is left
    assert all(output != "map" for output, _ in hands.published)


def test_a_bag_of_a_verification_is_not_solved_as_a_calibration(folder, capsys):
    plan = folder / "verifying.yaml"
    plan.write_text("plan_id: verifying\nverify: r.json\nviews: [{name: again}]\n")
    assert main(["plan", "check", str(plan)]) == 0
    simulate(
        folder,
        "verifying",
        {
            "plan_id": "v",
            "verify": str(folder / "r.json"),
            "artifact": PLATE,
            "views": VIEWS,
        },
        noise_seed=2,
        **MACHINE,
    )
    capsys.readouterr()
    assert main(["solve", str(folder / "verifying")]) == 2
    assert f"selfcal verify {folder / 'r.json'} BAG" in capsys.readouterr().err

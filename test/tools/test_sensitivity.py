# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.laser.data import Method
from selfcal_ros.applications.laser.simulation import case_study_machine
from selfcal_ros.reporting.figures.drawing import Label
from selfcal_ros.reporting.figures.drawing import Path as Line
from tools import sensitivity as tool
from tools.sensitivity import (
    FAULTS,
    effect_of,
    main,
    sensitivity_figure,
    sensitivity_text,
    sweep,
)

NM = 1e-9
BY_NAME = {fault.name: fault for fault in FAULTS}


def effects(name, size=None):
    fault, machine = BY_NAME[name], case_study_machine()
    return [
        effect_of(
            fault,
            fault.size if size is None else size,
            machine,
            method=method,
            rng=np.random.default_rng(0),
        )
        for method in Method
    ]


def test_the_new_formulation_does_not_see_the_mirror():
    conventional, new = effects("mirror off, pp")
    # Ex(x) errs by b/2 x angle = 5 um a block, less the part of the own diagonals.
    assert conventional.linear_m == pytest.approx(5e-6, rel=0.02)
    assert max(vars(new).values()) < 1e-3 * NM


def test_a_laser_along_its_own_diagonal_spoils_only_the_conventional_linear_errors():
    conventional, new = effects("none: laser along the machine's own diagonal")
    assert 30 * NM < conventional.linear_m < 45 * NM
    assert conventional.squareness_m < 1 * NM and max(vars(new).values()) < 1e-3 * NM
    conventional, new = effects("none: laser along the nominal diagonal")
    assert (
        max(vars(conventional).values()) < 1e-3 * NM
        and max(vars(new).values()) < 0.1 * NM
    )


def test_a_laser_off_on_one_diagonal_errs_by_its_cosine():
    _, new = effects("laser off, pp")
    # |D| psi^2/2 = 42.4 nm too short; half of it counts, times |D|/L = sqrt(2).
    assert new.squareness_m == pytest.approx(
        60e-3 * np.sqrt(2) * 0.5e-6 / 2 * np.sqrt(2), rel=0.01
    )
    _, alike = effects("laser off, pp and np equally")
    assert alike.squareness_m < 1e-2 * NM
    _, smaller = effects("laser off, pp", 1e-4)
    assert smaller.squareness_m == pytest.approx(new.squareness_m / 100, rel=0.02)


def test_angular_errors_act_on_both_formulations_alike():
    conventional, new = effects("X turns steadily, per block")
    # After i blocks the mirror has turned by i urad; the reading of a step errs by turn x step.
    assert new.transverse_m == pytest.approx(5 * 1e-6 * 0.01, rel=0.01)
    assert conventional.transverse_m == pytest.approx(new.transverse_m, rel=0.01)
    _, beside = effects("X turns steadily, beam 10 mm off the point")
    assert beside.squareness_m > new.squareness_m + 30 * NM


def test_noise_of_the_linear_measurement_cancels_between_the_diagonals():
    conventional, new = effects("noise of the linear measurement, 3 repeats")
    assert new.transverse_m < 0.01 * NM and new.linear_m > 5 * NM
    assert conventional.linear_m == pytest.approx(
        effects("none: laser along the machine's own diagonal")[0].linear_m
    )


def test_the_unit_of_the_laser_on_one_diagonal_leans_the_axes():
    _, new = effects("unit of length of the laser, pp")
    assert new.squareness_m == pytest.approx(1e-7 * 0.06, rel=0.01)


def test_what_is_no_fault_has_no_size():
    none = [fault for fault in FAULTS if fault.name.startswith("none")]
    assert len(none) == 2 and all(
        (fault.size, fault.unit) == (0.0, "") for fault in none
    )
    assert all(fault.size and fault.unit for fault in FAULTS if fault not in none)


def test_random_faults_are_repeated_as_often_as_their_names_say():
    repeats = [
        fault.apply(case_study_machine(), fault.size)[1].noise.repeats
        for fault in FAULTS
        if fault.random
    ]
    assert repeats == [3, 3]


def test_the_table_has_a_line_for_every_row():
    values = dict.fromkeys(
        ("linear_m", "transverse_m", "squareness_m", "straightness_m"), 1e-6
    )
    rows = [
        {
            "fault": "mirror off",
            "size": 1e-3,
            "unit": "rad",
            "conventional": values,
            "new": values,
        }
    ] * 2
    lines = sensitivity_text(rows).splitlines()
    assert len(lines) == 4 and lines[2].split()[2:] == ["0.001", "rad", *["1.0000"] * 8]


def test_the_sweep_is_over_the_angles_of_laser_and_mirror(monkeypatch):
    monkeypatch.setattr(tool, "SWEEP", (1e-4, 1e-3))
    rows = sweep(case_study_machine(), np.random.default_rng(0))
    assert [row["fault"] for row in rows] == [
        "mirror off, pp",
        "mirror off, pp and np equally",
        "laser off, pp",
        "laser off, pp and np equally",
        "laser and mirror off, pp",
        "laser and mirror off, pp and np equally",
    ]
    for row in rows:
        assert row["size"] == [1e-4, 1e-3]
        for place, size in enumerate(row["size"]):
            expected = effects(row["fault"], size)
            assert [row[str(method)][place] for method in Method] == [
                pytest.approx(vars(one)) for one in expected
            ]


def test_curves_stand_over_powers_of_ten():
    effect = dict.fromkeys(("linear_m", "transverse_m", "squareness_m"), 1e-9)
    nothing = dict.fromkeys(effect, 0.0)
    curves = [
        {
            "fault": "mirror off",
            "size": [1e-4, 1e-3, 1e-2],
            "conventional": [nothing, effect, dict.fromkeys(effect, 1e-6)],
            "new": [nothing] * 3,
        }
    ]
    drawing = sensitivity_figure(curves)
    low, middle, high = next(
        item.lines[0] for item in drawing.items if isinstance(item, Line) and item.dash
    )
    assert middle[0] - low[0] == pytest.approx(high[0] - middle[0])
    assert low[1] - middle[1] == pytest.approx(middle[1] - high[1])  # 1 pm, 1 nm, 1 um
    words = {item.text for item in drawing.items if isinstance(item, Label)}
    assert {"10⁻⁴", "10⁻²", "10⁻⁶", "10⁰", "mirror off"} <= words


def test_the_table_and_its_curves(tmp_path, capsys, monkeypatch):
    picture = tmp_path / "s.svg"
    monkeypatch.setattr(tool, "NOISE_DRAWS", 2)
    monkeypatch.setattr(tool, "SWEEP", (1e-4, 1e-3))
    monkeypatch.setattr("sys.argv", ["sensitivity.py", "--plot", str(picture)])
    assert main() == 0 and "<svg" in picture.read_text()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(FAULTS) + 2 and "mirror off, pp " in lines[4]

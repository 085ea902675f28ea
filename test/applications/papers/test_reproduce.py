# SPDX-License-Identifier: Apache-2.0
"""The published simulations come out as published, or differ where the paper cannot be right."""

import numpy as np
import pytest

from selfcal_ros.applications.papers import hu as module
from selfcal_ros.applications.papers.figures import hu_figures, qiao_figures
from selfcal_ros.applications.papers.hu import hu_text, reproduce_hu
from selfcal_ros.applications.papers.ibaraki import (
    CASE_STUDY_UM,
    ESTIMATED_MM,
    ibaraki_text,
    reproduce_ibaraki,
)
from selfcal_ros.applications.papers.qiao import ROWS, SIZES, qiao_text, reproduce_qiao
from selfcal_ros.applications.papers.readings import hu_plan, simulate_measurements
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.reporting.figures.drawing import Discs, Path
from selfcal_ros.simulation.machine import random_truth
from test.support.drawings import cut_off, words_on_words


@pytest.fixture(scope="module")
def hu():
    return reproduce_hu(40, seed=1)


@pytest.fixture(scope="module")
def qiao():
    return reproduce_qiao(25, seed=1)


def test_figures_are_whole_and_their_keys_lie_beside_the_panels(hu, qiao):
    figures = [*hu_figures(hu), *qiao_figures(qiao)]
    assert [figure.name for figure in figures] == [
        *(f"hu_figure_{number}" for number in range(4, 10)),
        "qiao_figure_3",
        "qiao_figure_4",
    ]
    for figure in figures:
        assert cut_off(figure) == [] and words_on_words(figure) == [], figure.name
        paths = [item for item in figure.items if isinstance(item, Path)]
        assert all(item.fill or item.width > 0 for item in paths), figure.name
        panels = [
            (item.lines[0][0], item.lines[0][2])
            for item in paths
            if item.stroke == "soft" and len(item.lines[0]) == 5
        ]
        draws = {
            round(float(x), 6)
            for item in figure.items
            if isinstance(item, Discs)
            for x, _ in item.centres
        }
        ends = {
            round(float(x), 6) for item in paths if item.dash for x, _ in item.lines[0]
        }
        # levels reach from the first draw to the last
        assert ends <= draws, figure.name
        keys = [item.lines[0][1] for item in paths if item.width == 1.4]
        assert bool(keys) == (figure in (figures[0], *figures[-2:]))
        assert not any(
            low[0] < x < high[0] and low[1] < y < high[1]
            for x, y in keys
            for low, high in panels
        ), figure.name


def test_hus_tables_lie_within_the_spread_of_draws(hu):
    for run in hu.runs:
        std = run.law.std
        published = np.array([row[2] for row in run.published.table])
        assert (
            np.abs(published - std.mean(axis=0)) < 2.5 * std.std(axis=0, ddof=1)
        ).all()
        ends = np.abs([row[:2] for row in run.published.table[:2]])
        found = np.abs(
            np.concatenate([run.law.xy.max(axis=(2, 3)), run.law.xy.min(axis=(2, 3))])
        )
        assert (ends > found.min() * 0.9).all() and (ends < found.max() * 1.1).all()


def test_joint_solution_reaches_the_bound_and_the_law_does_not(hu):
    for run in hu.runs:
        joint, law = (float(np.sqrt(np.mean(e.xy**2))) for e in (run.joint, run.law))
        assert joint == pytest.approx(run.bound[0], rel=0.04)
        assert law > 1.08 * run.bound[0]
        assert np.sqrt(np.mean(run.joint.theta**2)) == pytest.approx(
            run.bound[1], rel=0.15
        )


def test_errors_scale_with_the_noise_and_vanish_without(hu):
    assert hu.noise_free_um < 1e-10 and hu.noise_free_deg < 1e-13
    first, second = (run.law.std.mean(axis=0) for run in hu.runs)
    assert first / second == pytest.approx([10, 10, 10], rel=0.15)


def test_the_worst_site_and_line_without_noise_are_reported(monkeypatch):
    def spoilt(truth, draws):
        found = real(truth, draws)
        if len(draws) == 1:
            found.xy[0, 1, 3, 4] = -2.0
            found.theta[0, 5] = -3.0
        return found

    real = module._law_errors
    monkeypatch.setattr(module, "_law_errors", spoilt)
    found = reproduce_hu(2, seed=1)
    assert (found.noise_free_um, found.noise_free_deg) == (2.0, 3.0)


def test_seeds_decide(hu):
    again, other = reproduce_hu(2, seed=1), reproduce_hu(2, seed=2)
    assert np.array_equal(again.truth.g, hu.truth.g)
    assert np.allclose(again.runs[0].law.xy, hu.runs[0].law.xy[:2], rtol=1e-9)
    assert not np.array_equal(other.truth.g, hu.truth.g)


def test_progress_of_both_tables_counts_up_to_all_draws():
    seen = []
    reproduce_hu(2, seed=1, progress=lambda done, total: seen.append((done, total)))
    assert {total for _, total in seen} == {4}
    done = [number for number, _ in seen]
    assert done == sorted(done) and done[-1] == 4 and 2 in done


def test_hus_text_shows_tables_and_figures(hu):
    text = hu_text(hu)
    for word in (
        "Table 1",
        "Table 2",
        "Figure 6",
        "Figure 7",
        "Figure 8",
        "Figure 9",
        "0.0195",
        "0.01781",
        "std of 40 draws",
    ):
        assert word in text
    series = text.split("Figure 8")[1].splitlines()[1]
    assert len(series.split(":")[1].split()) == 10
    text = hu_text(reproduce_hu(1, seed=3))
    assert "std of 1 draw " in text and "±" not in text and "nan" not in text


def test_hus_text_names_the_row_that_contradicts_itself(hu):
    """Values with given extremes scatter least if all others lie in the middle."""
    said = [line for line in hu_text(hu).splitlines() if "contradicts" in line]
    assert len(said) == 1 and said[0].startswith(
        "the published row of EGth contradicts itself"
    )
    assert hu_text(hu).index("Table 2") < hu_text(hu).index(said[0])
    for table in module.TABLES:
        for row, count in enumerate((121, 121, 24)):
            high, low, std = table.table[row]
            least = np.std([high, low, *[(high + low) / 2] * (count - 2)], ddof=1)
            assert table.least_std(row) == pytest.approx(least)
            assert (std < least) == (table.name == "Table 2" and row == 2)


def test_ibarakis_figures_stand_beside_ours():
    found = reproduce_ibaraki(20, seed=1)
    for case, values in found.table_1_mm.items():
        assert values == pytest.approx(ESTIMATED_MM[case], abs=2e-4)
    measured, _, conventional = np.array(list(CASE_STUDY_UM.values()), dtype=float).T
    assert found.new_um.mean(axis=0) == pytest.approx(measured, abs=0.01)
    assert found.conventional_um.mean(axis=0) == pytest.approx(conventional, abs=0.2)
    rows = {
        line[:16].strip(): line.split()[-6:]
        for line in ibaraki_text(found).splitlines()
    }
    assert rows["squareness"] == [
        "squareness",
        "-1.22",
        "-1.32",
        "-1.22",
        "-1.37",
        "-1.22",
    ]


def test_qiaos_ranks_programs_and_bound(qiao):
    assert qiao.ranks.shape == (18, 5)
    for row, ranks, unknowns in zip(ROWS, qiao.ranks, qiao.unknowns, strict=True):
        assert list(ranks) == [row.rank(n) for n in SIZES]
        assert list(unknowns) == [4 * n**2 + row.extra for n in SIZES]
    good, bad = qiao.programs
    assert good.deficiency == 0 and good.rms_um < 1e-10
    assert bad.deficiency == 10 and bad.rms_um > 0.05
    assert qiao.bound_um == pytest.approx(0.0890, abs=1e-4)


def test_qiaos_noise_run_meets_the_bound_not_the_printed_figure(qiao):
    rms = float(np.sqrt(np.mean(qiao.rms_um**2)))
    assert rms == pytest.approx(qiao.bound_um, rel=0.04)
    uniform = float(np.sqrt(np.mean(qiao.rms_uniform_um**2)))
    assert uniform == pytest.approx(qiao.bound_um / np.sqrt(3), rel=0.04)
    assert uniform == pytest.approx(0.051, abs=0.002)


def test_the_unseen_part_of_program_2_is_all_that_is_wrong(qiao):
    from selfcal_ros.applications.papers.qiao import ARTIFACT, PROGRAMS, plan_of
    from selfcal_ros.estimation.normal.equations import planned_system
    from selfcal_ros.estimation.observability.rank import is_unseen

    system = planned_system(ARTIFACT, plan_of(PROGRAMS[1]).views)
    error = qiao.programs[1].found_um - qiao.programs[1].truth_um
    assert np.abs(error).max() > 0.1
    assert is_unseen(system, error[0] + 1j * error[1])


def test_qiaos_text(qiao):
    text = qiao_text(qiao)
    assert "90 of 90 ranks as printed" in text and "!" not in text
    assert "not reproducible as printed" in text and "0.0563 and 0.0572" in text


def test_degrees_of_freedom_of_simulated_means_are_those_of_their_repeats():
    plan = hu_plan(Artifact(5, 0.01, 8), repeats=3)
    rng = np.random.default_rng(1)
    readings = simulate_measurements(random_truth(plan.artifact, 4, rng), plan, rng)
    for view in readings.views:
        assert view.dof_xy == 2 * (3 - 1) * len(view.m)
        assert view.dof_theta == (3 - 1) * len(view.k)
    assert sum(len(view.k) for view in readings.views) >= 8

# SPDX-License-Identifier: Apache-2.0
"""Programs as CAM writes them, corrected with a measured map and run on the true stage.

They were written for this test, in the dialects of Fusion's post for GRBL, LinuxCNC and FlatCAM.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from selfcal_ros.applications.controllers.gcode import Rewriter
from selfcal_ros.applications.controllers.grid import Wiring, wanted
from selfcal_ros.apply import StageMap
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.gcode_machines import Machine, farthest
from test.support.truth import hu_plan, simulate_measurements

PROGRAMS = sorted((Path(__file__).parent / "programs").iterdir())
ZERO = np.array([-0.026, -0.022])
"""The programs' zero in the stage frame, m."""
FRAME = MachineFrame(unit="m", home_x_m=ZERO[0], home_y_m=ZERO[1])
TOLERANCE_M, ROUNDING_M = 0.05e-6, 1e-9
DIALECTS = {".nc": "grbl", ".ngc": "linuxcnc", ".gcode": "grbl"}
TOKEN = re.compile(r"\(.*?\)|;.*|[A-Za-z]\s*[-+.\d]+|\S")


class Measured:
    """A smooth stage, the map that was measured on it, and U of the map."""

    def __init__(self) -> None:
        plan, rng = hu_plan(Artifact(9, 0.008), repeats=2), np.random.default_rng(27)
        truth = random_truth(
            plan.artifact,
            len(plan.views),
            rng,
            Spread(g_m=4e-6, correlation_pitches=3.0),
        )
        self.result = calibrate(simulate_measurements(truth, plan, rng, sigma_m=80e-9))
        nodes = plan.artifact.x_m[:, 0]
        self._g = [RectBivariateSpline(nodes, nodes, part) for part in truth.g]
        self._map = StageMap(self.result)

    def reached(self, points: np.ndarray) -> np.ndarray:
        """Return where the stage goes when these positions of the program are commanded."""
        indicated = points + ZERO
        true = indicated
        for _ in range(8):  # indicated = true + G(true)
            true = indicated - np.stack([g.ev(*true.T) for g in self._g], axis=1)
        return true - ZERO

    def expanded(self, points: np.ndarray) -> np.ndarray:
        """Return U of the map at positions of the program: that of the worse axis."""
        u = self._map.uncertainty(*(points + ZERO).T)
        return self.result.noise.k_xy * np.maximum(*u)


@pytest.fixture(scope="module")
def stage():
    return Measured()


def corrected(stage: Measured, path: Path, sign: float = 1.0):
    """Yield each line of a program and those that replace it."""
    correct = wanted(stage.result.error_map, Wiring(FRAME, negate=sign < 0))
    rewriter = Rewriter(
        correct,
        dialect=DIALECTS[path.suffix],
        tolerance_m=TOLERANCE_M,
        step_m=0.25e-3,
        decimals=6,
    )
    for number, line in enumerate(path.read_text().splitlines(), 1):
        yield line, rewriter.line(line, f"{path.name}:{number}")


def distances(
    stage: Measured, path: Path, sign: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of the true path from the programmed one and back, and U there."""
    programmed, machine = (Machine(DIALECTS[path.suffix]) for _ in range(2))
    off, limits, known = [], [], False
    for line, out in corrected(stage, path, sign):
        ideal, made = (
            programmed.run(line),
            [move for text in out for move in machine.run(text)],
        )
        in_xy = any(np.ptp(move.points[:, :2], axis=0).any() for move in ideal)
        if in_xy and len(ideal[-1].points) > 1:
            if len(ideal) > 1:  # a cycle: the hole
                ideal, made = ideal[-2:-1], made[-2:-1]
            whole = ideal[0].points[:, :2] * 1e-3
            way = stage.reached(
                1e-3
                * np.vstack(
                    [
                        m.points[0]
                        + np.linspace(0, 1, 8)[:, None] * (m.points[-1] - m.points[0])
                        for m in made
                    ]
                )[:, :2]
            )
            pairs = [(way[-1:], whole[-1:])]
            if known and not ideal[0].rapid:
                pairs += [(way[::6], whole), (whole[::40], way)]
            for some, path_of in pairs:
                off += [
                    farthest(point[None], np.vstack([path_of, path_of[-1:]]))
                    for point in some
                ]
                limits.append(stage.expanded(some))
            known = True
        known &= not ideal or len(ideal[-1].points) > 1
    return np.array(off), np.concatenate(limits)


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_the_true_path_is_within_the_chord_tolerance_and_u(stage, path):
    off, limits = distances(stage, path)
    assert len(off) > 200 and off.max() > 1.2 * TOLERANCE_M  # U is needed
    within = off <= TOLERANCE_M + ROUNDING_M + limits
    assert within.mean() > 0.95
    assert (off <= TOLERANCE_M + ROUNDING_M + 1.5 * limits).all()


def test_with_the_opposite_sign_it_is_far_outside(stage):
    off, limits = distances(stage, PROGRAMS[0], sign=-1.0)
    assert (off > TOLERANCE_M + 3 * limits).mean() > 0.5


def kept(line: str) -> list[str]:
    """Return the words of a line but those of its way."""
    return sorted(
        re.sub(r"\s", "", word)
        for word in TOKEN.findall(line)
        if word[0] in "(;"
        or (word[0] not in "XYZIJR" and not re.fullmatch("G0?[0-3]", word))
    )


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_words_and_comments_are_kept(stage, path):
    moves = 0
    for line, (first, *more) in corrected(stage, path):
        assert [w for w in kept(first) if w != "G81"] == [
            w for w in kept(line) if w != "G81"
        ]
        assert all(re.fullmatch(r"G1 X\S+ Y\S+( Z\S+)?", text) for text in more)
        moves += bool(more)
    assert moves >= 8

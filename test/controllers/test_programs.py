# SPDX-License-Identifier: Apache-2.0
"""Programs as CAM writes them, corrected with a measured map and run on the true stage.

They were written for this test, in the dialects of Fusion's post for GRBL, LinuxCNC and FlatCAM.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from selfcal_ros.apply import StageMap
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.controllers.gcode import Rewriter
from selfcal_ros.controllers.grid import Wiring, wanted
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.programs import Machine, farthest
from test.support.truth import hu_plan, simulate_measurements

PROGRAMS = sorted((Path(__file__).parent / "programs").iterdir())
ZERO = np.array([-0.026, -0.022])
"""The programs' zero in the stage frame, m."""
FRAME = MachineFrame(unit="m", home_x_m=ZERO[0], home_y_m=ZERO[1])
TOLERANCE_M, ROUNDING_M = 0.05e-6, 1e-9
TOKEN = re.compile(r"\(.*?\)|;.*|[A-Za-z]\s*[-+.\d]+|\S")


class Measured:
    """A smooth stage, the map that was measured on it, and U of the map."""

    def __init__(self) -> None:
        plan, rng = hu_plan(Artifact(9, 0.008), repeats=2), np.random.default_rng(27)
        truth = random_truth(plan.artifact, len(plan.views), rng,
                             Spread(g_m=4e-6, correlation_pitches=3.0))
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
    rewriter = Rewriter(correct, tolerance_m=TOLERANCE_M, step_m=0.25e-3, decimals=6)
    for number, line in enumerate(path.read_text().splitlines(), 1):
        yield line, rewriter.line(line, f"{path.name}:{number}")


def distances(stage: Measured, path: Path, sign: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of the true path from the programmed one and back, and U there."""
    programmed, machine = Machine(), Machine()
    off, limits = [], []
    for line, out in corrected(stage, path, sign):
        ideal, made = programmed.line(line), [machine.line(text) for text in out]
        assert (ideal is None) == (made == [None])
        if ideal is None:
            continue
        way = np.concatenate([stage.reached(points) for _, points in made])
        drawn = ideal[0] in ("1", "2", "3") and len(ideal[1]) > 1
        pairs = [(way[-1:], ideal[1][-1:]), (way[::8], ideal[1])]
        for some, whole in [*pairs, (ideal[1][::8], way)] if drawn else pairs[:1]:
            off += [farthest(point[None], whole) for point in some]
            limits.append(stage.expanded(some))
    return np.array(off), np.concatenate(limits)


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_the_true_path_is_within_the_chord_tolerance_and_u(stage, path):
    off, limits = distances(stage, path)
    assert len(off) > 200 and off.max() > 1.2 * TOLERANCE_M  # U is needed
    within = off <= TOLERANCE_M + ROUNDING_M + limits
    assert within.mean() > 0.95
    assert (off <= TOLERANCE_M + ROUNDING_M + 1.5 * limits).all()


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_with_the_opposite_sign_it_is_far_outside(stage, path):
    off, limits = distances(stage, path, sign=-1.0)
    assert (off > TOLERANCE_M + 3 * limits).mean() > 0.5


def kept(line: str, *, arc: bool) -> list[str]:
    """Return the words of a move without values of X and Y; an arc's as those of a line."""
    words = [re.sub(r"\s", "", w) if w[0] not in "(;" else w for w in TOKEN.findall(line)]
    dropped = "IJR" if arc else ""
    return [w[0] if w[0] in "XY" else "G1" if arc and re.fullmatch("G0?[23]", w) else w
            for w in words if w[0] not in dropped]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_words_comments_and_their_order_are_kept(stage, path):
    machine, moves, split = Machine(), 0, 0
    for line, (first, *more) in corrected(stage, path):
        move = machine.line(line)
        if move is None:
            assert (first, more) == (line, [])
            continue
        moves, split = moves + 1, split + bool(more)
        before, after = kept(line, arc=move[0] in ("2", "3")), kept(first, arc=False)
        if more:  # the end of Z is that of the last piece
            before, after = ([w[0] if w[0] == "Z" else w for w in one] for one in (before, after))
            ends = [re.findall(r"Z\s*([-.\d]+)", text) for text in (line, more[-1])]
            assert [float(z) for z in ends[0]] == [float(z) for z in ends[1]]
        for axis in "XY":  # one that was not there is added
            if axis not in before:
                after.remove(axis)
        assert after == before, line
        assert all(re.fullmatch(r"X\S+ Y\S+( Z\S+)?", text) for text in more)
    assert moves > 15 and split >= 8

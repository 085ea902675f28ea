# SPDX-License-Identifier: Apache-2.0
"""A planned measurement with terms as one dense least squares: the slow way, for comparison."""

from functools import cached_property

import numpy as np
from scipy.stats import f as central_f
from scipy.stats import ncf

from selfcal_ros.estimation.terms.planned import planned_inputs
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm

SIGMA = 20e-9
TURNS = [
    np.array(rows)
    for rows in (
        [[1, 0], [0, 1]],
        [[0, -1], [1, 0]],
        [[-1, 0], [0, -1]],
        [[0, 1], [-1, 0]],
    )
]


def _inverse(matrix):
    """Return the pseudo-inverse of a matrix whose columns have unlike units."""
    norm = np.linalg.norm(matrix, axis=0)
    return np.linalg.pinv(matrix / norm, rcond=1e-11) / norm[:, None]


class Dense:
    """Every visit of a plan as two rows of one matrix, in the stage frame, for unit noise."""

    def __init__(self, plan, assumed, sense=Sense.MICROSCOPE_MOVES):
        self.plan, self.assumed, self.sense = plan, assumed, sense
        self.nx, self.ny = plan.artifact.shape
        self.half = plan.artifact.grid_pitch_m * max(plan.artifact.half)
        # offsets and random orders are an assumption of the plan: they are taken as they are
        self.visits = planned_inputs(plan.artifact, plan.views, assumed).visits
        self.rows, self.weight, self.about, self.times = [], [], [], []
        for v, visits in enumerate(self.visits):
            self._view(v, visits)
        self._known = {}
        self.base = np.array(self.rows)
        self.root = np.sqrt(np.array(self.weight))

    def _view(self, v, visits):
        pose = self.plan.views[v].lattice_pose(self.plan.artifact)
        turn = TURNS[pose.quarter_turns]
        hx, hy = self.plan.artifact.half
        exposures, last, came = 0.0, None, np.zeros(2)
        times = []
        for mark, weight, offset in zip(
            visits.mark, visits.weight, visits.offset, strict=True
        ):
            place = np.array([mark // self.ny - hx, mark % self.ny - hy])
            at = turn @ place + np.array(pose.shift)
            stage = at if self.sense is Sense.MICROSCOPE_MOVES else -at
            if last is not None:
                moved = np.sign(stage - last)
                came = np.where(moved == 0, came, moved)
            last = stage
            times.append(exposures + (weight - 1) / 2)
            exposures += weight
            self._reading(v, mark, stage, place * self.plan.artifact.grid_pitch_m, turn)
            self.weight += [weight] * 2
            self.about.append(
                (
                    v,
                    place * self.plan.artifact.grid_pitch_m / self.half,
                    turn,
                    np.array([offset.real, offset.imag]),
                    came.copy(),
                )
            )
        self.times += list(
            2 * (np.array(times) - times[0]) / (times[-1] - times[0]) - 1
        )

    def _reading(self, v, mark, stage, place, turn):
        hx, hy = self.plan.artifact.half
        sites, indicated = self.nx * self.ny, self._indicated()
        site = (stage[0] + hx) * self.ny + stage[1] + hy
        for axis in range(2):
            row = np.zeros(4 * sites + 3 * len(self.visits))
            row[2 * site + axis] = indicated
            row[2 * sites + 2 * mark : 2 * sites + 2 * mark + 2] = turn[axis]
            k = 4 * sites + 3 * v
            turned = turn @ place / self.half
            row[k : k + 3] = (-turned[1], 1, 0) if axis == 0 else (turned[0], 0, 1)
            self.rows.append(row)

    def _indicated(self):
        return 1 if self.sense is Sense.MICROSCOPE_MOVES else -1

    def _once(self, what, make):
        """Return what was computed before under a key, or compute it."""
        if what not in self._known:
            self._known[what] = make()
        return self._known[what]

    def columns(self, name, *, free):
        """Columns of a term at every row: what a unit of each coefficient does to a reading."""
        return self._once((name, free), lambda: self._columns(name, free))

    def _columns(self, name, free):
        out = []
        views = range(len(self.visits))
        if name == "microscope":
            one = np.array(
                [
                    [[1, 0], [0, 1]],
                    [[0, -1], [1, 0]],
                    [[1, 0], [0, -1]],
                    [[0, 1], [1, 0]],
                ]
            )
            out = [[-(e @ offset) for _, _, _, offset, _ in self.about] for e in one]
        elif name == "approach":
            out = [
                [self._indicated() * np.array(h) * came for *_, came in self.about]
                for h in ((1, 0), (0, 1))
            ]
        elif name == "drift":
            of_view = np.array([about[0] for about in self.about])
            for v in views:
                for degree in range(1, self.assumed.drift_degree + 1):
                    course = np.polynomial.Legendre.basis(degree)(np.array(self.times))
                    out += [
                        np.outer(course * (of_view == v), d) for d in ((1, 0), (0, 1))
                    ]
        else:
            of_view = np.array([about[0] for about in self.about])
            x, y = np.array([place for _, place, *_ in self.about]).T
            turns = np.array([turn for _, _, turn, *_ in self.about])
            scale = np.stack([x, y]) * self.half
            saddle, twice, round_ = x * x - y * y, 2 * x * y, x * x + y * y
            shapes = {
                "plate_scale": [scale],
                "plate_strain": [scale, scale * [[1], [-1]], scale[::-1]],
                "plate_shape": [
                    np.stack(each)
                    for each in (
                        (saddle, twice),
                        (-twice, saddle),
                        (round_, 0 * x),
                        (0 * x, round_),
                        (saddle, -twice),
                        (twice, saddle),
                    )
                ],
            }[name]
            out = [
                np.einsum("rij,jr->ri", turns, shape) * (of_view == v)[:, None]
                for v in views[int(free) :]
                for shape in shapes
            ]
        return np.array(out).reshape(len(out), -1).T

    def design(self, terms):
        """Weighted rows: unknowns, then the terms' coefficients; sizes as rows below."""
        blocks = [self.columns(t.name, free=t.free) for t in terms]
        whole = self.root[:, None] * np.hstack([self.base, *blocks])
        sizes = np.concatenate(
            [np.zeros(self.base.shape[1])]
            + [
                np.full(block.shape[1], 0 if t.free else SIGMA / t.size)
                for t, block in zip(terms, blocks, strict=True)
            ]
        )
        prior = np.diag(sizes)[sizes > 0]
        return np.vstack([whole, prior])

    @cached_property
    def datum(self):
        """Projection of a map on what remains without translation, rotation and scale."""
        hx, hy = self.plan.artifact.half
        place = np.array(
            [(i, j) for i in range(-hx, hx + 1) for j in range(-hy, hy + 1)]
        )
        one, none = np.ones(len(place)), np.zeros(len(place))
        modes = np.array(
            [
                np.stack(pair, axis=1).ravel()
                for pair in (
                    (one, none),
                    (none, one),
                    (-place[:, 1], place[:, 0]),
                    (place[:, 0], place[:, 1]),
                )
            ]
        )
        q = np.linalg.qr(modes.T.astype(float))[0]
        return np.eye(len(q)) - q @ q.T

    def to_map(self, unknowns):
        return self.datum @ unknowns[: 2 * self.nx * self.ny]

    def n_unseen(self, terms):
        """Independent maps that can be added without changing any reading."""
        return self._once(("unseen", *terms), lambda: self._n_unseen(terms))

    def _n_unseen(self, terms):
        design = self.design(terms)
        scaled = design / np.linalg.norm(design, axis=0)
        # the triangle has the singular values and right vectors of the whole
        _, size, right = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
        null = (
            right[(size > 1e-9 * size[0]).sum() :].T
            / np.linalg.norm(design, axis=0)[:, None]
        )
        maps = self.to_map(null / np.linalg.norm(null, axis=0))
        return int((np.linalg.svd(maps, compute_uv=False) > 1e-7).sum())

    def solver(self, terms):
        """Matrix that takes weighted readings to unknowns, and the design."""
        return self._once(("solver", *terms), lambda: self._solver(terms))

    def _solver(self, terms):
        design = self.design(terms)
        feigned = self._feigned(terms)
        more = np.zeros((len(design) + len(feigned.T), len(feigned.T)))
        more[: len(feigned)] = feigned
        more[len(design) :] = np.eye(len(feigned.T)) / (SIGMA * len(self.weight))
        rows = np.vstack([design, np.zeros((len(feigned.T), design.shape[1]))])
        return _inverse(np.hstack([rows, more]))[: design.shape[1]], design

    def _feigned(self, terms):
        """Changes of the readings that only scale or stretch of a microscope has (7.11)."""
        whole = self.design([ModelTerm(term.name) for term in terms])
        at, found = self.base.shape[1], []
        for term in terms:
            if term.name == "microscope":
                found = [at, at + 2]
            at += self.columns(term.name, free=True).shape[1]
        return _inverse(whole)[found].T

    def gain(self, terms):
        """Root mean square of the standard uncertainty for unit noise of one reading."""
        solve, _ = self.solver(terms)
        return np.sqrt((self.to_map(solve) ** 2).sum(axis=1).mean())

    def effect(self, terms, name, size):
        solve, _ = self.solver(terms)
        column = self.root[:, None] * self.columns(name, free=False)
        moved = self.to_map(solve[:, : len(column)] @ column) * size
        spread = np.sqrt((moved**2).sum(axis=1))
        return np.sqrt((spread**2).mean()), spread.max()

    @staticmethod
    def _rank(design):
        return np.linalg.matrix_rank(
            np.linalg.qr(design / np.linalg.norm(design, axis=0), mode="r"), tol=1e-9
        )

    def power(self, terms, name, size, level, draws=300):
        """Mean over drawn coefficients of the power of the noncentral F-test."""
        free = [ModelTerm(term.name) for term in terms]
        before = self.design(free)
        solve = self._once(("plain", *free), lambda: _inverse(before))
        column = self.root[:, None] * self.columns(name, free=False)
        left = column - before @ (solve @ column)
        rank_before = self._once(("rank", *free), lambda: self._rank(before))
        rank = np.linalg.matrix_rank(left / np.linalg.norm(column, axis=0), tol=1e-5)
        dof = len(before) - rank_before - rank
        b = np.random.default_rng(5).normal(size=(draws, column.shape[1])) * size
        shift = ((left @ b.T) ** 2).sum(axis=0) / SIGMA**2
        limit = central_f.isf(level, rank, dof)
        return float(
            np.mean(
                np.where(
                    shift > 2000, 1.0, ncf.sf(limit, rank, dof, np.minimum(shift, 2000))
                )
            )
        )

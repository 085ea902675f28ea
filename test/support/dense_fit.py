# SPDX-License-Identifier: Apache-2.0
"""A measurement with terms as one dense least squares: the slow way, for comparison.

Written from method.md, not from the code: every visit of a mark and every line is a row in the
stage frame, every unknown a column, every size a row b / size. The columns are differences of what
the whole model predicts, so that plates that turn by finite angles have theirs, too.
"""

from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import eval_legendre

from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.terms import ModelTerm

STEP = 1e-5
"""Of the differences, rad, m and m/m: what they leave out and what they round are then 1e-11."""

STEPS = 6
"""In which finite turns and offsets without their noise are found to rounding."""

PLACE_STEPS = 12
"""In which the stage error where the stage stood is found to a thousandth of its uncertainty."""

EXACTLY = 1e-4
"""Part of the noise to which the map is held in its datum. Without finite turns no reading tells
it; with them a microscope's turn and scale are those against the axes that it has."""

NOTHING = 1e-8
"""Singular value of columns of unit length that is none."""

MARKS = {
    "plate_scale": ("scale",),
    "plate_strain": ("scale", "stretch", "shear"),
    "plate_shape": tuple(
        f"{form} {axis}" for form in ("z^2", "|z|^2", "z*^2") for axis in "xy"
    ),
}


class DenseFit:
    """The solution of all readings for known noises of one reading, (m, rad).

    `shared`: part of the variance that may be noise of the indicated position; `contrast`: part
    by which the variance is larger along x and smaller along y, equal weights nevertheless;
    `correlation`: of the noise of visits by their distance in time, from 1. With `places` each
    visit has the stage error of the place where the stage stood, and the equations are those of
    the sites all the same.
    """

    def __init__(
        self,
        readings: Measurements,
        terms: tuple[ModelTerm, ...],
        sigma,
        *,
        degree=3,
        rigid=False,
        shared=1.0,
        places=True,
        contrast=0.0,
        correlation=(),
    ):
        self.readings, self.sigma, self.rigid, self.shared = (
            readings,
            sigma,
            rigid,
            shared,
        )
        self.contrast, self.correlation = contrast, correlation
        self.artifact = readings.artifact
        (self.hx, self.hy), self.pitch = self.artifact.half, self.artifact.grid_pitch_m
        self.n, self.K = int(np.prod(self.artifact.shape)), self.artifact.angular_count
        self.sign = -1 if readings.sense is Sense.PLATE_MOVES else 1
        self.keys, self.size = self._coefficients(terms, degree)
        self._visits()
        self._lines()
        ends = np.cumsum(
            [
                0,
                2 * self.n,
                2 * self.n,
                self.K,
                self.K,
                3 * len(readings.views),
                len(self.keys),
            ]
        )
        self.g, self.a, self.gt, self.at, self.pose, self.b = (
            slice(*pair) for pair in pairwise(ends)
        )
        self.offset, self.line_offset = (
            self.seen,
            self.line_seen - self._left_by_lines(),
        )
        self.p = np.zeros(ends[-1])
        magnified = any(term in ("microscope", "line_scale") for term, *_ in self.keys)
        self.places = places
        self.steps = PLACE_STEPS if places else STEPS if magnified or rigid else 1
        for number in range(self.steps):
            self._columns = self._of_coefficients()
            # between them the slopes hardly change
            if number in (0, 1, self.steps - 1):
                self._linearise()
            self._step()
            # the noise of a reading is in the offset that was seen as well (method, terms)
            self.offset = self.seen - self.left

    def _coefficients(self, terms, degree):
        """Names (term, view, component) and sizes of all coefficients; view -1: all views."""
        views = self.readings.views
        grid = [v for v, view in enumerate(views) if len(view.m)]
        lines = [v for v, view in enumerate(views) if len(view.k)]
        keys, size = [], []
        for term in terms:
            if term.name == "microscope":
                mine = [(-1, part) for part in ("scale", "turn", "stretch", "shear")]
            elif term.name == "line_scale":
                mine = [(-1, "scale")] if lines else []
            elif term.name == "approach":
                mine = [(-1, "x"), (-1, "y")]
            elif term.name == "drift":
                mine = [
                    (v, f"{axis} P{order}")
                    for v in grid
                    for order in range(1, degree + 1)
                    for axis in "xy"
                ]
            elif term.name == "line_eccentricity":
                mine = [
                    (v, part)
                    for v in lines[int(term.free) :]
                    for part in ("cos", "sin")
                ]
            elif term.name == "rotation":
                both = [v for v in lines if v in grid]
                mine = [(v, "turn") for v in both[int(term.free) :] if len(both) > 1]
            else:  # a yaw has columns with images only
                mine = [
                    (v, part)
                    for v in grid[int(term.free) :]
                    for part in MARKS.get(term.name, ())
                ]
            for v, part in mine:
                if term.size_of(part):
                    keys.append((term.name, v, part))
                    size.append(term.size_of(part))
        return keys, np.array(size)

    def _visits(self):
        """Every visit of every mark, one behind another."""
        parts = {
            name: []
            for name in ("view", "m", "n", "y", "weight", "tau", "o", "sx", "sy")
        }
        for v, view in enumerate(self.readings.views):
            if not len(view.m):
                continue
            seen = view.visits
            first, last = seen.stamp_ns.min(), seen.stamp_ns.max()
            for name, values in (
                ("view", np.full(len(seen.mark), v)),
                ("m", view.m[seen.mark]),
                ("n", view.n[seen.mark]),
                ("y", seen.dx + 1j * seen.dy),
                ("weight", seen.count),
                ("tau", 2 * (seen.stamp_ns - first) / (last - first) - 1),
                ("o", seen.offset_x + 1j * seen.offset_y),
                ("sx", seen.approach_x),
                ("sy", seen.approach_y),
            ):
                parts[name].append(values)
        found = {name: np.concatenate(values) for name, values in parts.items()}
        self.view, self.tau, self.seen = found["view"], found["tau"], found["o"]
        self.sx, self.sy = found["sx"], found["sy"]
        self.z = self.pitch * (found["m"] + 1j * found["n"])
        self.mark = (
            (found["m"] + self.hx) * self.artifact.shape[1] + found["n"] + self.hy
        )
        poses = [view.view for view in self.readings.views]
        self.quarter = np.array(
            [1j ** round(pose.rotation_rad / (np.pi / 2)) for pose in poses]
        )
        shift = np.array([complex(*pose.translation_m) for pose in poses])
        place = self.quarter[self.view] * self.z + shift[self.view]
        at = np.rint(
            self.sign * np.stack([place.real, place.imag]) / self.pitch
        ).astype(int)
        self.site = (at[0] + self.hx) * self.artifact.shape[1] + at[1] + self.hy
        self.y, self.visit_weight = found["y"], found["weight"].astype(float)
        # offset = mark - stage, or mark + stage where the stage carries the plate along
        self.stage = self.sign * (place + self.y - self.seen)

    def _lines(self):
        """Every line of every view, one behind another."""
        views = [(v, view) for v, view in enumerate(self.readings.views) if len(view.k)]
        empty = [np.zeros(0, dtype=int)]
        self.k = np.concatenate([view.k for _, view in views] or empty)
        self.line_view = np.concatenate(
            [np.full(len(view.k), v) for v, view in views] or empty
        )
        self.line_y = np.concatenate([view.dtheta for _, view in views] or empty)
        self.line_seen = np.concatenate(
            [view.dtheta - view.axis_theta for _, view in views] or empty
        )
        self.line_weight = np.concatenate(
            [view.count_theta for _, view in views] or empty
        )
        turn = np.array(
            [
                round(view.view.rotation_rad / (2 * np.pi / self.K)) if self.K else 0
                for view in self.readings.views
            ]
        )
        self.line_site = self.sign * (self.k + turn[self.line_view]) % max(self.K, 1)

    def _left_by_lines(self):
        """What lines leave if their views turn as they like."""
        every = np.eye(self.K)
        turns = np.eye(len(self.readings.views))[self.line_view]
        columns = np.concatenate(
            [self.sign * every[self.line_site], every[self.k], turns], axis=1
        )
        weight = np.sqrt(self.line_weight)
        found = np.linalg.lstsq(
            weight[:, None] * columns, weight * self.line_y, rcond=None
        )[0]
        return self.line_y - columns @ found

    def _of_stage(self, g):
        """The stage error at every visit: where the stage truly stood, or at the site."""
        error = g[self.site]
        if not self.places:
            return error
        field = g.reshape(self.artifact.shape)
        for _ in range(3):  # true = indicated - error
            true = (self.stage - error) / self.pitch
            along = (
                splines_of(size)(part + half)
                for size, part, half in zip(
                    field.shape, (true.real, true.imag), (self.hx, self.hy), strict=True
                )
            )
            error = np.einsum("vi,vj,ij->v", *along, field)
        return error

    def _predicted(self, p, at_sites=False):
        """What the model says of all readings: visits along x, along y, lines."""
        g, a = (part[: self.n] + 1j * part[self.n :] for part in (p[self.g], p[self.a]))
        phi, x, y = p[self.pose].reshape(-1, 3).T
        strained, added, turned = (p[self.b] @ columns for columns in self._columns)
        quarter, body = self.quarter[self.view], a[self.mark] + strained
        t = (x + 1j * y)[self.view]
        if self.rigid:
            turn = np.exp(1j * phi)[self.view] * quarter
            moved = turn * (self.z + body) + t - quarter * self.z
        else:
            moved = quarter * (body + 1j * phi[self.view] * self.z) + t
        moved = (
            moved
            + added
            + self.sign * (g[self.site] if at_sites else self._of_stage(g))
        )
        lines = (
            self.sign * p[self.gt][self.line_site]
            + p[self.at][self.k]
            + phi[self.line_view]
        )
        return np.concatenate([moved.real, moved.imag, lines + turned])

    def _of_coefficients(self):
        """What a unit of each makes of the plate at the visits, of the visits, of the lines."""
        strained, added = np.zeros((2, len(self.keys), len(self.z)), dtype=complex)
        turned = np.zeros((len(self.keys), len(self.k)))
        for row, (term, v, part) in enumerate(self.keys):
            if term in ("line_eccentricity", "rotation"):
                wave = {"cos": np.cos, "sin": np.sin, "turn": np.ones_like}[part]
                turned[row] = wave(2 * np.pi * self.k / self.K) * (self.line_view == v)
            elif term == "line_scale":
                turned[row] = -self.line_offset
            elif term in MARKS:
                strained[row] = self._of_plate(part, term) * (self.view == v)
            else:
                added[row] = self._of_visit(term, part) * ((self.view == v) | (v < 0))
        return strained, added, turned

    def _of_plate(self, part, term):
        z, half = self.z, self.pitch * max(self.hx, self.hy)
        if term == "plate_shape":
            u, v = z.real / half, z.imag / half
            form, axis = part.split()
            saddle, round_ = u * u - v * v, u * u + v * v
            return {
                "z^2": saddle + 2j * u * v,
                "|z|^2": round_,
                "z*^2": saddle - 2j * u * v,
            }[form] * (1 if axis == "x" else 1j)
        x, y = z.real, z.imag
        return {"scale": x + 1j * y, "stretch": x - 1j * y, "shear": y + 1j * x}[part]

    def _of_visit(self, term, part):
        if term == "drift":
            return eval_legendre(int(part[3:]), self.tau) * (
                1 if part[0] == "x" else 1j
            )
        if term == "approach":
            return self.sign * (self.sx if part == "x" else 1j * self.sy)
        x, y = self.offset.real, self.offset.imag
        return -{
            "scale": x + 1j * y,
            "turn": -y + 1j * x,
            "stretch": x - 1j * y,
            "shear": y + 1j * x,
        }[part]

    @cached_property
    def _root(self):
        marks = np.sqrt(self.visit_weight) / self.sigma[0]
        return np.concatenate([marks, marks, np.sqrt(self.line_weight) / self.sigma[1]])

    @cached_property
    def _values(self):
        return np.concatenate([self.y.real, self.y.imag, self.line_y])

    def _design(self, p, at_sites=True):
        unit = STEP * np.eye(len(p))
        return np.array(
            [
                (self._predicted(p + h, at_sites) - self._predicted(p - h, at_sites))
                / (2 * STEP)
                for h in unit
            ]
        ).T

    def _linearise(self):
        """Keep the equations about the unknowns as they are, and the covariance."""
        p, sized = self.p, np.isfinite(self.size)
        self.design = self._root[:, None] * self._design(p)
        prior = np.zeros((sized.sum(), len(p)))
        prior[np.arange(len(prior)), np.arange(len(p))[self.b][sized]] = (
            1 / self.size[sized]
        )
        held = np.concatenate(
            [
                self._datum(np.unique(self.site)),
                np.roll(
                    self._datum(np.unique(self.mark))[:3],
                    self.a.start - self.g.start,
                    axis=1,
                ),
            ]
        )
        held = held / (EXACTLY * self.sigma[0])
        solve = self._solved(np.concatenate([self.design, prior, held]), held)
        self.covariance, self._solve = (
            solve @ self._noise(solve.shape[1]) @ solve.T,
            solve,
        )
        self._known = np.concatenate([prior, held])

    def _step(self):
        """Take a step to the least squares; keep unknowns and what is left."""
        rest = self._root * (self._values - self._predicted(self.p))
        known = np.concatenate([rest, -self._known @ self.p])
        self.p = self.p + self._solve[:, : len(known)] @ known
        left, n = self._values - self._predicted(self.p), len(self.y)
        self.left = left[:n] + 1j * left[n : 2 * n]

    def with_places_in_covariance(self):
        """Let the covariance be that of the equations of the sites for readings at the places."""
        here = self._root[:, None] * self._design(self.p, at_sites=False)
        more = self._solve[:, : len(here)] @ (here - self.design)
        spread = np.linalg.inv(np.eye(len(self.p)) + more)
        self.covariance = spread @ self.covariance @ spread.T

    def _noise(self, n_rows):
        """Covariance of all rows, in units of their own noise."""
        n, noise = len(self.y), np.eye(n_rows)
        for start, part in ((0, self.contrast), (n, -self.contrast)):
            noise[start : start + n, start : start + n] += part * np.eye(n)
            for v in set(self.view):
                order = (
                    start
                    + np.flatnonzero(self.view == v)[
                        np.argsort(self.tau[self.view == v], kind="stable")
                    ]
                )
                for lag, rho in enumerate(self.correlation, 1):
                    noise[order[:-lag], order[lag:]] += rho
                    noise[order[lag:], order[:-lag]] += rho
        return noise

    def _solved(self, rows, held):
        """Pseudo-inverse of rows where noise of the position may feign a scale of the microscope.

        Changes of the readings that add up to 1 with the columns of scale or stretch, and to 0 with
        all others, are unknowns of the size 2 `shared` visits (method eq. 7.11).
        """
        feigned = [
            at
            for at, (term, _, part) in enumerate(self.keys, self.b.start)
            if term == "microscope" and part in ("scale", "stretch")
        ]
        changes = inverse_of(np.concatenate([self.design, held]))[
            feigned, : len(self.design)
        ].T
        more = np.zeros((len(rows) + len(feigned), len(feigned)))
        more[: len(changes)] = changes
        more[len(rows) :] = np.eye(len(feigned)) / (2 * len(self.y) * self.shared)
        rows = np.concatenate([rows, np.zeros((len(feigned), rows.shape[1]))])
        return inverse_of(np.concatenate([rows, more], axis=1))[: len(self.p)]

    @property
    def squares(self):
        """Sum of squares of what is left and of the rows of the sizes."""
        rest = self._root * (self._values - self._predicted(self.p))
        return float(rest @ rest + ((self.p[self.b] / self.size) ** 2).sum())

    def grid(self, known):
        """Map and its u in the datum over the sites `known`: (2, nx, ny) each."""
        sites = np.flatnonzero(known)
        modes = self._datum(sites)
        self.to_map = np.zeros((2 * self.n, len(self.p)))
        here = np.concatenate([sites, self.n + sites])
        self.to_map[here, here] = 1
        self.to_map -= modes.T[: 2 * self.n] @ modes
        return self._quantity(self.to_map, (2, *self.artifact.shape))

    def _datum(self, sites):
        """Translation, rotation and scale of the map over sites as orthonormal rows."""
        x, y = (part.ravel()[sites] for part in (self.artifact.x_m, self.artifact.y_m))
        one, zero = np.ones(len(sites)), np.zeros(len(sites))
        modes = np.stack(
            [
                np.concatenate(pair)
                for pair in ((one, zero), (zero, one), (-y, x), (x, y))
            ],
            axis=1,
        )
        rows = np.zeros((4, len(self.p)))
        rows[:, np.concatenate([sites, self.n + sites])] = np.linalg.qr(modes)[0].T
        return rows

    def plate(self, known, sites):
        """Plate's map and its u, marks `known` without translation and rotation: (2, nx, ny)."""
        marks, sites = np.flatnonzero(known), np.flatnonzero(sites)
        modes = self._datum(marks)[:3, : 2 * self.n]
        pick = np.zeros((2 * self.n, len(self.p)))
        pick[:, self.a] = np.eye(2 * self.n)
        x, y = self.artifact.x_m.ravel(), self.artifact.y_m.ravel()
        pick += np.outer(np.concatenate([x, y]), self._part(sites, self.g, 3))
        here = np.concatenate([marks, self.n + marks])
        pick[here] -= (modes.T @ (modes @ pick))[here]
        self.to_plate = pick
        return self._quantity(pick, (2, *self.artifact.shape))

    def _part(self, nodes, where, mode):
        """Row of a rotation (2) or scale (3) of a map over nodes."""
        x, y = (part.ravel()[nodes] for part in (self.artifact.x_m, self.artifact.y_m))
        one, zero = np.ones(len(nodes)), np.zeros(len(nodes))
        modes = np.stack(
            [
                np.concatenate(pair)
                for pair in ((one, zero), (zero, one), (-y, x), (x, y))
            ],
            axis=1,
        )
        row = np.zeros(len(self.p))
        row[np.arange(len(row))[where][np.concatenate([nodes, self.n + nodes])]] = (
            np.linalg.pinv(modes)[mode]
        )
        return row

    def plate_theta(self, lines, sites, marks):
        """Plate's angular map and its u, (K,): stage's mean 0 over `lines`, no map turned."""
        pick = np.zeros((self.K, len(self.p)))
        pick[:, self.at] = np.eye(self.K)
        pick[:, self.gt] += self.sign * np.asarray(lines) / np.sum(lines)
        pick -= self._part(np.flatnonzero(sites), self.g, 2)
        pick -= self._part(np.flatnonzero(marks), self.a, 2)
        return self._quantity(pick, (self.K,))

    def theta(self, known, axes=False):
        """Angular map and its standard uncertainty over the lines `known`, (K,) each.

        In the datum zero_mean, or in xy_axes, after `grid` (method eqs. 3.7, 3.8).
        """
        pick = np.zeros((self.K, len(self.p)))
        pick[:, self.gt] = np.eye(self.K)
        if axes:
            pick = pick + self._gain() @ self._misclosure(pick)
        else:
            pick = pick - pick[known].mean(axis=0)
        return self._quantity(pick, (self.K,))

    def _misclosure(self, pick):
        """Slopes of the half axes less the angular map there, as rows over the unknowns."""
        shape, rows = self.artifact.shape, []
        number = np.arange(self.n).reshape(shape)
        i, j = self.artifact.x_m, self.artifact.y_m
        for line, (sites, along, part, sign) in enumerate(
            (
                (number[self.hx + 1 :, self.hy], i, 1, 1),
                (number[self.hx, self.hy + 1 :], j, 0, -1),
                (number[: self.hx, self.hy], i, 1, 1),
                (number[self.hx, : self.hy], j, 0, -1),
            )
        ):
            x = along.ravel()[sites] - along.ravel()[sites].mean()
            slope = sign * (x / (x @ x)) @ self.to_map[part * self.n + sites]
            rows.append(slope - pick[line * self.K // 4])
        return np.array(rows)

    def _gain(self):
        """What the angular map makes of a misclosure, rotations of the grid's views held."""
        lines = 2 * len(self.y) + np.arange(len(self.k))
        columns = np.r_[
            np.arange(len(self.p))[self.gt],
            np.arange(len(self.p))[self.at],
            [
                self.pose.start + 3 * v
                for v, view in enumerate(self.readings.views)
                if len(view.k) and not len(view.m)
            ],
        ]
        solve = inverse_of(self.design[np.ix_(lines, columns)])
        spread = (solve @ solve.T)[: self.K, : self.K] / self.sigma[1] ** 2
        b = np.eye(self.K)[np.arange(4) * self.K // 4]
        one = b.sum(axis=1)[:, None]
        border = np.block([[b @ spread @ b.T, one], [one.T, np.zeros((1, 1))]])
        solved = np.linalg.pinv(border)[:, :4]
        return spread @ b.T @ solved[:4] + solved[4]

    def _quantity(self, rows, shape):
        variance = np.einsum("ij,jk,ik->i", rows, self.covariance, rows)
        return (rows @ self.p).reshape(shape), np.sqrt(variance).reshape(shape)

    def coefficients(self):
        """(value, standard uncertainty) of every coefficient by (term, view's name, component)."""
        names = [*(view.view.name for view in self.readings.views), ""]
        u = np.sqrt(np.diag(self.covariance)[self.b])
        return {
            (str(term), names[v], part): (value, spread)
            for (term, v, part), value, spread in zip(
                self.keys, self.p[self.b], u, strict=True
            )
        }


@cache
def splines_of(size):
    """Return the splines that are 1 at one of so many places and 0 at the others."""
    return CubicSpline(np.arange(size), np.eye(size))


def inverse_of(matrix):
    """Return the pseudo-inverse of a matrix whose columns have unlike units."""
    norm = np.linalg.norm(matrix, axis=0)
    norm[norm == 0] = 1
    return np.linalg.pinv(matrix / norm, rcond=NOTHING) / norm[:, None]

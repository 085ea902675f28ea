# SPDX-License-Identifier: Apache-2.0
"""A calibration and a later view of the same plate as one dense least squares.

Written from method.md, not from the code: two maps of the stage, one plate, one microscope,
misalignments of every view, linear in the rotations; all readings in one matrix, its pseudo-inverse
the estimate.
"""

import numpy as np

from selfcal_ros.model.readings import Measurements, Sense
from test.support import placed

MICROSCOPE = (0.01, 0.01, 0.002, 0.002)


class TwoSessions:
    """The estimate of both maps: that before from the earlier readings alone.

    `grid`: the plate with the nodes of the map, `microscope`: sizes of its four coefficients, none
    without; `known`: nodes of the later map, all by default.
    """

    def __init__(
        self,
        before: Measurements,
        after: Measurements,
        grid,
        sigma,
        microscope=(),
        known=None,
        sigma_theta=1.0,
    ):
        self.grid, self.sigma = grid, sigma
        self.n, self.marks = grid.field.m.size, grid.m.size
        views = [
            *((0, view) for view in before.views),
            *((1, view) for view in after.views),
        ]
        self.sign = -1 if before.sense is Sense.PLATE_MOVES else 1
        self.e = len(microscope)
        self.K, first = grid.angular_count, 4 * self.n + 2 * self.marks + 3 * len(views)
        self.lines, size = slice(first, first + 3 * self.K), first + 3 * self.K + self.e
        blocks, values, session = [], [], []
        for number, (of, view) in enumerate(views):
            if len(view.m):
                row, y = self._rows(of, number, view, size)
                blocks += [row.real, row.imag]
                values += [y.real, y.imag]
                session += [np.full(2 * len(view.m), of)]
            if len(view.k):
                blocks.append(self._line_rows(of, number, view, size))
                values.append(view.dtheta * np.sqrt(view.count_theta) / sigma_theta)
                blocks[-1] *= np.sqrt(view.count_theta)[:, None] / sigma_theta
                session.append(np.full(len(view.k), of))
        prior = np.zeros((self.e, size))
        if self.e:
            prior[:, -self.e :] = np.diag(1 / np.array(microscope))
        design = np.vstack([*blocks, prior])
        y = np.concatenate([*values, np.zeros(self.e)])
        early = np.concatenate([*session, np.zeros(self.e)]) == 0
        old = np.zeros((size, len(y)))
        old[:, early] = pinv(design[early])
        both = pinv(design)
        self.y, whole = y, placed.datum_modes(grid.field, scale=True).reshape(4, -1).T
        here = np.full(2 * self.n, True) if known is None else np.tile(known.ravel(), 2)
        # both sessions with the scale in which the earlier map has none
        grown = np.outer(whole[:, 3], np.linalg.pinv(whole)[3] @ both[: 2 * self.n])
        before = without(old[: 2 * self.n], whole)
        after = (both[2 * self.n : 4 * self.n] - grown)[here]
        self.scale = np.linalg.pinv(whole[here])[3] @ (after - before[here])
        of_lines = np.stack([old[self.lines], both[self.lines]]).reshape(
            2, 3, self.K, len(y)
        )
        of_lines = of_lines - of_lines.sum(axis=2, keepdims=True) / max(self.K, 1)
        self.after_theta = of_lines[1, 1]
        self.change_theta = of_lines[1, 1] - of_lines[0, 0]
        self.before, self.known = before, here
        self.after = without(after, whole[here])
        self.change = without(after - before[here], whole[here])

    def _rows(self, of, number, view, size):
        n, marks, pitch = self.n, self.marks, self.grid.grid_pitch_m
        at = view.view.pose.places(self.grid, view.m, view.n)
        phase = np.exp(1j * view.view.rotation_rad)
        row = np.zeros((len(view.m), size), dtype=complex)
        w = placed.rows(self.grid, self.sign * at) * self.sign
        (
            row[:, 2 * n * of : 2 * n * of + n],
            row[:, 2 * n * of + n : 2 * n * of + 2 * n],
        ) = w, 1j * w
        own = np.zeros((len(view.m), marks))
        (hx, hy), ny = self.grid.half, self.grid.shape[1]
        own[np.arange(len(view.m)), (view.m + hx) * ny + view.n + hy] = 1
        row[:, 4 * n : 4 * n + marks] = phase * own
        row[:, 4 * n + marks : 4 * n + 2 * marks] = 1j * phase * own
        first = 4 * n + 2 * marks + 3 * number
        z = (view.m + 1j * view.n) * pitch / (pitch * max(hx, hy))
        row[:, first : first + 3] = np.stack(
            [phase * 1j * z, 1 + 0 * z, 1j + 0 * z], axis=1
        )
        if self.e:  # one visit of each mark
            o = np.zeros(len(view.m), dtype=complex)
            o[view.visits.mark] = view.visits.offset_x + 1j * view.visits.offset_y
            row[:, -4:] = -np.stack([o, 1j * o, o.conj(), 1j * o.conj()], axis=1)
        root = np.sqrt(view.count) / self.sigma
        return row * root[:, None], (view.dx + 1j * view.dy) * root

    def _line_rows(self, of, number, view, size):
        row, each = np.zeros((len(view.k), size)), np.arange(len(view.k))
        turn = round(view.view.rotation_rad / (2 * np.pi / self.K))
        site = self.sign * (view.k + turn) % self.K
        row[each, self.lines.start + of * self.K + site] = self.sign
        row[each, self.lines.start + 2 * self.K + view.k] = 1
        length = self.grid.grid_pitch_m * max(self.grid.half)
        row[:, 4 * self.n + 2 * self.marks + 3 * number] = 1 / length
        return row

    def of(self, rows):
        """Value and standard uncertainty of an estimate of the later map, (2 known,) each."""
        return rows @ self.y, np.sqrt((rows**2).sum(axis=1))

    @property
    def chi2(self):
        """Squared Mahalanobis distance of the change, and its degrees of freedom."""
        cover, values = self.change @ self.change.T, self.change @ self.y
        rank = np.linalg.matrix_rank(cover, tol=1e-7 * np.trace(cover))
        return values @ np.linalg.pinv(cover, rcond=1e-8, hermitian=True) @ values, rank


def without(rows, modes):
    """Rows of a map less its least-squares parts in modes."""
    return rows - modes @ (np.linalg.pinv(modes) @ rows)


def pinv(matrix):
    """Pseudo-inverse of a matrix whose columns have unlike units."""
    norm = np.linalg.norm(matrix, axis=0)
    norm[norm == 0] = 1
    return np.linalg.pinv(matrix / norm, rcond=1e-10) / norm[:, None]

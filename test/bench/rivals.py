# SPDX-License-Identifier: Apache-2.0
"""Other solvers on the same grid readings: the textbook ways to solve a sparse least squares."""

import importlib.util

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.lattice.readings import grid_data
from selfcal_ros.estimation.normal.grid import GridSystem

RIVALS = ("numpy.linalg.lstsq", "scipy lsmr", "scipy splu", "gtsam", "pyceres")


def jacobian(grid: GridSystem) -> csr_matrix:
    """Return the matrix of all grid readings over G, A (x, y a node) and phi, tau a view."""
    view, mark = np.nonzero(grid.read.reshape(grid.n_views, -1))
    site = grid.views.site_index.reshape(grid.n_views, -1)[view, mark]
    back = PHASES[-np.array([pose.q for pose in grid.views.poses]) % 4][view]
    z, n, one = (
        grid.views.z.ravel()[mark],
        grid.n_sites,
        np.ones(len(mark), dtype=complex),
    )
    entries = (
        (2 * site, back),
        (2 * site + 1, 1j * back),
        (2 * n + 2 * mark, one),
        (2 * n + 2 * mark + 1, 1j * one),
        (4 * n + 3 * view, 1j * z),
        (4 * n + 3 * view + 1, one),
        (4 * n + 3 * view + 2, 1j * one),
    )
    rows, cols, data = [], [], []
    for column, value in entries:
        for part, values in ((0, value.real), (1, value.imag)):
            used = values != 0
            rows.append(2 * np.flatnonzero(used) + part)
            cols.append(column[used])
            data.append(values[used])
    shape = (2 * len(mark), 4 * n + 3 * grid.n_views)
    at = np.concatenate(rows), np.concatenate(cols)
    return coo_matrix((np.concatenate(data), at), shape=shape).tocsr()


def pinned(grid: GridSystem) -> np.ndarray:
    """Return the columns that stay when seven numbers are held: the sparse choice of a datum."""
    n, (nx, ny) = grid.n_sites, grid.views.shape
    middle, edge = (nx // 2) * ny + ny // 2, (nx - 1) * ny + ny // 2
    held = [
        2 * middle,
        2 * middle + 1,
        2 * edge,
        2 * edge + 1,
        2 * n + 2 * middle,
        2 * n + 2 * middle + 1,
        2 * n + 2 * edge + 1,
    ]
    return np.setdiff1d(np.arange(4 * n + 3 * grid.n_views), held)


class Rival:
    """One of `RIVALS` set up on readings; the set-up is not part of its time."""

    def __init__(self, name: str, measurements) -> None:
        data = grid_data(measurements)
        self.grid = GridSystem(data.poses, data.weight)
        matrix = jacobian(self.grid)
        values = data.y.reshape(len(data.poses), -1)[
            self.grid.read.reshape(len(data.poses), -1)
        ]
        self.right = np.column_stack([values.real, values.imag]).ravel()
        self.keep = pinned(self.grid)
        self.full, self.matrix = matrix, matrix[:, self.keep].tocsc()
        self._run = {
            "numpy.linalg.lstsq": self._dense,
            "scipy lsmr": self._lsmr,
            "scipy splu": self._splu,
            "gtsam": self._gtsam,
            "pyceres": self._pyceres,
        }[name]
        if name == "gtsam":
            self._graph = self._gtsam_graph()

    def solve(self) -> np.ndarray:
        """Return G, (2, nx, ny), in no particular datum."""
        field = self._run()[: 2 * self.grid.n_sites].reshape(*self.grid.views.shape, 2)
        return np.moveaxis(field, -1, 0)

    def _spread(self, kept: np.ndarray) -> np.ndarray:
        out = np.zeros(self.full.shape[1])
        out[self.keep] = kept
        return out

    def _dense(self) -> np.ndarray:
        return np.linalg.lstsq(self.full.toarray(), self.right, rcond=None)[0]

    def _lsmr(self) -> np.ndarray:
        from scipy.sparse.linalg import lsmr

        return self._spread(
            lsmr(
                self.matrix,
                self.right,
                atol=1e-14,
                btol=1e-14,
                conlim=0,
                maxiter=100_000,
            )[0]
        )

    def _splu(self) -> np.ndarray:
        from scipy.sparse.linalg import splu

        normal = (self.matrix.T @ self.matrix).tocsc()
        factor = splu(
            normal,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return self._spread(factor.solve(self.matrix.T @ self.right))

    def _gtsam_graph(self):
        import gtsam

        graph, n = gtsam.GaussianFactorGraph(), self.grid.n_sites
        view, mark = np.nonzero(self.grid.read.reshape(self.grid.n_views, -1))
        site = self.grid.views.site_index.reshape(self.grid.n_views, -1)[view, mark]
        z, unit = self.grid.views.z.ravel(), gtsam.noiseModel.Unit.Create(2)
        turns = [
            np.array([[p.real, -p.imag], [p.imag, p.real]])
            for p in (PHASES[-pose.q % 4] for pose in self.grid.views.poses)
        ]
        rights = self.right.reshape(-1, 2)
        for row, (v, m, s) in enumerate(
            zip(view.tolist(), mark.tolist(), site.tolist(), strict=True)
        ):
            turn = np.array([[-z[m].imag, 1, 0], [z[m].real, 0, 1]])
            graph.add(
                gtsam.JacobianFactor(
                    s, turns[v], n + m, np.eye(2), 2 * n + v, turn, rights[row], unit
                )
            )
        held = np.setdiff1d(np.arange(self.full.shape[1]), self.keep)
        for node in sorted(set((held // 2).tolist())):
            rows = np.eye(2)[[h % 2 for h in held if h // 2 == node]]
            graph.add(
                gtsam.JacobianFactor(
                    node,
                    rows,
                    np.zeros(len(rows)),
                    gtsam.noiseModel.Unit.Create(len(rows)),
                )
            )
        return graph

    def _gtsam(self) -> np.ndarray:
        solution = self._graph.optimize()
        return np.concatenate([solution.at(s) for s in range(self.grid.n_sites)])

    def _pyceres(self) -> np.ndarray:
        import pyceres

        blocks = [np.zeros(self.matrix.shape[1])]
        problem = pyceres.Problem()
        problem.add_residual_block(
            _linear_cost(pyceres, self.matrix, self.right), None, blocks
        )
        options = pyceres.SolverOptions()
        options.max_num_iterations = 3
        options.minimizer_progress_to_stdout = False
        pyceres.solve(options, problem, pyceres.SolverSummary())
        return self._spread(blocks[0])


def _linear_cost(pyceres, matrix, right):
    """Return the readings as one dense cost function, the only form that pyceres offers here."""

    class Linear(pyceres.CostFunction):
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(len(right))
            self.set_parameter_block_sizes([matrix.shape[1]])

        def Evaluate(self, parameters, residuals, jacobians):
            residuals[:] = matrix @ parameters[0] - right
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = matrix.toarray().ravel()
            return True

    return Linear()


def installed(name: str) -> bool:
    """Return whether a rival's package can be imported."""
    return (
        name not in ("gtsam", "pyceres") or importlib.util.find_spec(name) is not None
    )

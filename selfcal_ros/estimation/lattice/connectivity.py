# SPDX-License-Identifier: Apache-2.0
"""Connected sites: components of the readings, closed turns, and sites that nothing checks.

Sites and marks are the nodes of a graph, a reading joins one mark to one site and carries the
view's quarter turns. With misalignments known, a component leaves two numbers free (a vector that
turns along with the readings) unless some closed path turns it: then it leaves none. Counting
components is therefore an exact rank.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True, eq=False)
class Components:
    """Components of sites and marks.

    Attributes
    ----------
    of_site, of_mark : int array (sites,), (marks,)
        Number of the component; -1 for a site never visited or a mark never read.
    balanced : bool array (components,)
        Whether no closed path turns a vector: the component leaves two numbers free.
    """

    of_site: np.ndarray
    of_mark: np.ndarray
    balanced: np.ndarray

    @classmethod
    def of_one(cls, sites: np.ndarray, marks: np.ndarray) -> "Components":
        """Return one component, without a free vector, of the nodes in bool arrays."""
        return cls(
            np.where(sites, 0, -1), np.where(marks, 0, -1), np.zeros(1, dtype=bool)
        )

    @property
    def first_sites(self) -> np.ndarray:
        """The first site of every component, int (components,)."""
        sites = np.flatnonzero(self.of_site >= 0)
        out = np.zeros(len(self.balanced), dtype=int)
        out[self.of_site[sites[::-1]]] = sites[::-1]
        return out

    @property
    def largest(self) -> int:
        """The component with the most sites; the first one if equal."""
        component_of_site = self.of_site[self.of_site >= 0]
        return int(
            np.bincount(component_of_site, minlength=len(self.balanced)).argmax()
        )


def components(
    site: np.ndarray, mark: np.ndarray, q: np.ndarray, *, n_sites: int, n_marks: int
) -> Components:
    """Return the components of readings.

    Parameters
    ----------
    site, mark, q : int arrays (readings,)
        Site and mark that each reading joins, and its quarter turns (0 for angular lines).
    n_sites, n_marks : int
        Number of sites and marks.
    """
    of_site, of_mark = np.full(n_sites, -1), np.full(n_marks, -1)
    if not len(site):
        return Components(of_site, of_mark, np.zeros(0, dtype=bool))
    first = np.empty(n_marks, dtype=int)
    first[mark[::-1]] = np.arange(len(mark))[::-1]
    # a mark joins the site of its first reading to its other sites
    further = np.flatnonzero(first[mark] != np.arange(len(mark)))
    start = first[mark[further]]
    turn = (q[further] - q[start]) % 4
    label = (
        _cover(site[start], site[further], turn, n_sites)
        if turn.any()
        else _connect(site[start], site[further], n_sites)[None]
    )
    touched = np.zeros(n_sites, dtype=bool)
    touched[site] = True
    # the copies of a site are in all components of the cover over its own component
    _, first_of_each, number = np.unique(
        label.min(axis=0)[touched], return_index=True, return_inverse=True
    )
    copies = label[:, np.flatnonzero(touched)[first_of_each]]
    balanced = (copies[1:] != copies[0]).all(axis=0)
    of_site[touched] = number
    of_mark[mark] = of_site[site]
    return Components(of_site, of_mark, balanced)


def _connect(a: np.ndarray, b: np.ndarray, n: int) -> np.ndarray:
    """Return the component of every node; edges join a to b."""
    order = np.argsort(a, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(a, minlength=n))])
    graph = csr_matrix((np.ones(len(a)), b[order], starts), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def _cover(a: np.ndarray, b: np.ndarray, turn: np.ndarray, n: int) -> np.ndarray:
    """Return the components (4, sites) of the fourfold cover: a vector in each of four turns."""
    turns = np.arange(4)[:, None]
    # a vector v on site a appears as i^turn v on site b
    from_a = np.broadcast_to(turns * n + a, (4, len(a)))
    to_b = ((turns + turn) % 4) * n + b
    return _connect(from_a.ravel(), to_b.ravel(), 4 * n).reshape(4, n)


def free_turns(
    site: np.ndarray, mark: np.ndarray, q: np.ndarray, components_read: Components
) -> tuple[np.ndarray, np.ndarray]:
    """Return the quarter turns of a component's free vector, int (sites,), (marks,).

    Relative to the first site of the component: with v the vector there, G = i^turn v and
    A = -i^turn v change no reading. 0 outside balanced components.

    Parameters
    ----------
    site, mark, q : int arrays (readings,)
        As for `components`.
    components_read : Components
        The components of these readings.
    """
    of_site = np.zeros(len(components_read.of_site), dtype=int)
    of_mark = np.zeros(len(components_read.of_mark), int)
    free = components_read.balanced[components_read.of_site[site]]
    if not free.any():
        return of_site, of_mark
    ends, place = np.unique(
        np.stack([site, mark + len(of_site)])[:, free], return_inverse=True
    )
    start, end = place.reshape(2, -1)
    # a vector v of a mark appears as i^q v on its site
    label = _cover(end, start, q[free], len(ends))
    at_site = ends < len(of_site)
    component = np.where(
        at_site,
        components_read.of_site[np.where(at_site, ends, 0)],
        components_read.of_mark[np.where(at_site, 0, ends - len(of_site))],
    )
    home = label[0][np.searchsorted(ends, components_read.first_sites[component])]
    turn = np.argmax(label == home, axis=0)
    of_site[ends[at_site]], of_mark[ends[~at_site] - len(of_site)] = (
        turn[at_site],
        turn[~at_site],
    )
    return of_site, of_mark


def rest_on_one(
    site: np.ndarray, mark: np.ndarray, *, n_sites: int, n_marks: int
) -> np.ndarray:
    """Return the sites whose error is known from single readings only, bool (sites,).

    A reading that is the only one of a site gives the site's error, and the only one of a mark
    gives the mark's: the fit follows it fully (1 - h = 0, method eq. 4.10), and no residual shows
    its error. Such readings carry no information on other sites and are removed, after which
    others may be the last of a site or mark; this is repeated until each remaining site and mark
    has two or more. Sites without remaining readings depend on single readings.

    Parameters
    ----------
    site, mark : int arrays (readings,)
        Site and mark joined by each reading: one per mark and view, whatever its repeats.
    n_sites, n_marks : int
        Number of sites and marks.
    """
    ends = np.stack([site, mark + n_sites])
    number = np.broadcast_to(np.arange(len(site)), ends.shape)
    n_left = np.bincount(ends.ravel(), minlength=n_sites + n_marks)
    # for a node with one reading left this sum is the index of that reading
    total = np.bincount(ends.ravel(), number.ravel(), n_sites + n_marks).astype(
        np.int64
    )
    read = n_left[:n_sites] > 0
    last = np.flatnonzero(n_left == 1)
    while len(last):
        off = np.unique(total[last])
        at = ends[:, off].ravel()
        np.subtract.at(n_left, at, 1)
        np.subtract.at(total, at, np.tile(off, 2))
        last = np.unique(at[n_left[at] == 1])
    return read & (n_left[:n_sites] == 0)


class Gauge:
    """Least-squares components of a complex field in modes, over the known sites.

    Parameters
    ----------
    z : complex array (nx, ny)
        Positions in units of the longer half width.
    known : bool array (nx, ny)
        Sites to use.
    scale : bool
        Whether magnification belongs to the datum (stage: yes, plate: no).
    """

    def __init__(self, z: np.ndarray, is_known: np.ndarray, *, scale: bool) -> None:
        self.z, self.known, self.scale = z, is_known, scale
        rows = self._rows
        self._gram_inverse = _inverse((rows.conj() @ rows.T).real)

    @property
    def _rows(self) -> np.ndarray:
        """The modes over the known sites, complex (modes, sites)."""
        return _modes(self.z, self.known)[: 4 if self.scale else 3]

    def coefficients(self, field: np.ndarray) -> np.ndarray:
        """Return the coefficients of the modes (1, i, iz, z) in `field`, (modes,)."""
        known = np.where(self.known, field, 0.0)
        total, moment = known.sum(), np.vdot(self.z, known)
        products = np.array([total.real, total.imag, moment.imag, moment.real])
        return self._gram_inverse @ products[: len(self._gram_inverse)]

    def dual(self, mode: int) -> np.ndarray:
        """Return the row that gives one of `coefficients`, complex (nx, ny), real inner product."""
        return (self._gram_inverse[mode] @ self._rows).reshape(self.known.shape)

    def remove(self, field: np.ndarray, modes: np.ndarray) -> np.ndarray:
        """Return `field` minus the modes with coefficients `modes`."""
        shift = complex(modes[0], modes[1])
        slope = complex(0.0, modes[2])
        if self.scale:
            slope += modes[3]
        return field - shift - slope * self.z

    @cached_property
    def orthonormal(self) -> np.ndarray:
        """Orthonormal basis of the modes, complex (sites, modes), real inner product."""
        rows = self._rows
        q = np.linalg.qr(np.concatenate([rows.real, rows.imag], axis=1).T)[0]
        n = self.known.size
        return q[:n] + 1j * q[n:]

    def without(self, fields: np.ndarray) -> np.ndarray:
        """Return fields (sites, ...), 0 where not known, without their parts in the modes."""
        return fields - self.orthonormal @ np.real(self.orthonormal.conj().T @ fields)

    @property
    def everywhere(self) -> np.ndarray:
        """The modes of `orthonormal` at all sites, complex (sites, modes)."""
        rows = self._rows
        modes = _modes(self.z, np.ones(self.known.shape, dtype=bool))[: len(rows)].T
        return modes @ (self._gram_inverse @ np.real(rows.conj() @ self.orthonormal))

    @cached_property
    def shear(self) -> np.ndarray:
        """Rows that give O and R of Hu eq. 6, times the half width: complex (2, nx, ny)."""
        back = (np.conj(self.z) * self.known).reshape(-1)
        flat = np.stack([*_modes(self.z, self.known), 1j * back, back])
        rows = _inverse((flat.conj() @ flat.T).real)[4:] @ flat
        return rows.reshape(2, *self.z.shape)


def _modes(z: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Return the modes 1, i, iz, z over the known sites, complex (4, sites)."""
    out = np.empty((4, z.size), dtype=complex)
    out[0], out[3] = is_known.reshape(-1), (z * is_known).reshape(-1)
    out[1], out[2] = 1j * out[0], 1j * out[3]
    return out


def _inverse(gram: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a Gram matrix: few sites may not separate all modes."""
    values, vectors = np.linalg.eigh(gram)
    good = values > 1e-12 * values[-1]
    return (vectors[:, good] / values[good]) @ vectors[:, good].T

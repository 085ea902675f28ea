# SPDX-License-Identifier: Apache-2.0
"""Which sites hang together: components of the readings, and whether turns close in them.

Sites and marks are the nodes, a reading joins one mark to one site and carries the view's
quarter turns. With misalignments known, a component leaves two numbers free (a vector that
turns along with the readings) unless some closed path turns it: then it leaves none. Counting
components is therefore an exact rank.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True, eq=False)
class Components:
    """Components of sites and marks.

    Attributes
    ----------
    of_site, of_mark : int array (sites,), (marks,)
        Number of the component; -1 for a site never visited or a mark never read.
    balanced : bool array (components,)
        No closed path turns a vector: the component leaves two numbers free.
    """

    of_site: np.ndarray
    of_mark: np.ndarray
    balanced: np.ndarray

    @property
    def first_sites(self) -> np.ndarray:
        """The first site of every component, int (components,)."""
        known = np.flatnonzero(self.of_site >= 0)
        out = np.zeros(len(self.balanced), dtype=int)
        out[self.of_site[known[::-1]]] = known[::-1]
        return out

    @property
    def largest(self) -> int:
        """The component with the most sites; the first of equals."""
        known = self.of_site[self.of_site >= 0]
        return int(np.bincount(known, minlength=len(self.balanced)).argmax())


def components(site: np.ndarray, mark: np.ndarray, q: np.ndarray, *, n_sites: int,
               n_marks: int, turning: int = -1) -> Components:
    """Return the components of readings.

    Parameters
    ----------
    site, mark, q : int arrays (readings,)
        Site and mark that each reading joins, and its quarter turns (0 for angular lines).
    n_sites, n_marks : int
        Number of sites and marks.
    turning : int
        A site known to lie in a component that is not balanced; -1 = none is known.
    """
    n_nodes = n_sites + n_marks
    _, label = _connect(site, mark + n_sites, n_nodes)
    touched = np.zeros(n_nodes, dtype=bool)
    touched[site], touched[mark + n_sites] = True, True
    numbers = np.full(n_nodes, -1)
    _, numbers[touched] = np.unique(label[touched], return_inverse=True)
    n_components = int(numbers.max(initial=-1)) + 1
    balanced = np.ones(n_components, dtype=bool)
    if n_components == 1 and turning >= 0:
        balanced[0] = False
    elif len(q) and np.ptp(q):
        balanced = _balanced(site, mark + n_sites, q, numbers=numbers, n=n_components)
    return Components(numbers[:n_sites], numbers[n_sites:], balanced)


def _connect(a: np.ndarray, b: np.ndarray, n: int) -> tuple[int, np.ndarray]:
    edges = coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(n, n))
    return connected_components(edges, directed=False)


def _balanced(site: np.ndarray, mark: np.ndarray, q: np.ndarray, *, numbers: np.ndarray,
              n: int) -> np.ndarray:
    """Return which components fall apart into four in the fourfold cover of the graph."""
    size = len(numbers)
    turns = np.arange(4)[:, None]
    # a vector v on the mark appears as i^q v on the site
    cover_site = ((turns + q) % 4) * size + site
    cover_mark = np.broadcast_to(turns * size + mark, cover_site.shape)
    _, label = _connect(cover_site.ravel(), cover_mark.ravel(), 4 * size)
    first = np.zeros(n, dtype=int)
    nodes = np.flatnonzero(numbers >= 0)[::-1]
    first[numbers[nodes]] = nodes
    copies = np.stack([label[first + k * size] for k in range(4)])
    return (copies[1:] != copies[0]).all(axis=0)

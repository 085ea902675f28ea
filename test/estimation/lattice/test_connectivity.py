# SPDX-License-Identifier: Apache-2.0
"""Which sites readings join, and whether their turns agree, against a walk from site to site."""

from collections import defaultdict

import numpy as np
import pytest

from selfcal_ros.estimation.lattice.connectivity import components, free_turns


def walked(site, mark, q):
    """Return the components by a plain walk: [(sites, whether all ways give one turn)]."""
    joins = defaultdict(list)
    for s, m, turn in zip(site.tolist(), mark.tolist(), q.tolist(), strict=True):
        joins["site", s].append((("mark", m), turn))
        joins["mark", m].append((("site", s), -turn))
    turned, out = {}, []
    for start in sorted(set(site.tolist())):
        if ("site", start) in turned:
            continue
        turned["site", start], todo, sites, agree = 0, [("site", start)], set(), True
        while todo:
            node = todo.pop()
            sites |= {node[1]} if node[0] == "site" else set()
            for other, turn in joins[node]:
                if other not in turned:
                    turned[other] = (turned[node] + turn) % 4
                    todo.append(other)
                agree &= turned[other] == (turned[node] + turn) % 4
        out.append((sites, agree))
    return out


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("readings", [1, 5, 9, 14, 30])
def test_components_are_those_that_a_walk_finds(readings, seed):
    rng = np.random.default_rng(seed)
    site, mark = rng.integers(0, 14, readings), rng.integers(0, 11, readings)
    q = rng.integers(0, 4, readings) * (rng.random(readings) < 0.3)
    found, expected = (
        components(site, mark, q, n_sites=14, n_marks=11),
        walked(site, mark, q),
    )
    assert len(found.balanced) == len(expected)
    for sites, agree in expected:
        number = found.of_site[min(sites)]
        assert set(np.flatnonzero(found.of_site == number).tolist()) == sites
        assert found.balanced[number] == agree
        assert found.first_sites[number] == min(sites)
        assert set(np.flatnonzero(found.of_mark == number).tolist()) == {
            m for s, m in zip(site.tolist(), mark.tolist(), strict=True) if s in sites
        }
    assert set(np.flatnonzero(found.of_site < 0)) == set(range(14)) - set(site.tolist())
    assert found.largest in [
        found.of_site[min(sites)]
        for sites, _ in expected
        if len(sites) == max(len(one) for one, _ in expected)
    ]


@pytest.mark.parametrize("seed", range(8))
def test_free_vectors_change_no_reading(seed):
    """Each component that no path turns has its own vector; of the others nothing is turned."""
    rng = np.random.default_rng(seed)
    site, mark = rng.integers(0, 30, 24), rng.integers(0, 30, 24)
    q = rng.integers(0, 4, 24)
    parts = components(site, mark, q, n_sites=31, n_marks=31)
    at_site, at_mark = free_turns(site, mark, q, parts)
    vector = np.append(
        parts.balanced * (rng.normal(size=(2, len(parts.balanced))).T @ [1, 1j]), 0
    )
    g, a = 1j**at_site * vector[parts.of_site], -(1j**at_mark) * vector[parts.of_mark]
    assert abs(g).any() and abs(1j**-q * g[site] + a[mark]).max() < 1e-12
    held = np.append(parts.balanced, False)
    assert (
        not at_site[~held[parts.of_site]].any()
        and not at_mark[~held[parts.of_mark]].any()
    )
    assert not at_site[parts.first_sites].any()

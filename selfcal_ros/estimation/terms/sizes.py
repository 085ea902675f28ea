# SPDX-License-Identifier: Apache-2.0
"""Whether the readings determine the terms of the model, and agree with their given sizes.

The coefficients of a term, estimated without their size, have b ~ N(0, C + size^2 1), with
C their covariance (method eq. 7.9). If this is contradicted, the readings give another size:
that at which b' (C + size^2 1)^-1 b equals its rank (Paule and Mandel 1982), and at most that at
which it is improbably small.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, fdtrc

from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.terms.equations import TermEquations
from selfcal_ros.model.error_map import MANY_DOF
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import ModelTerm

SIZE_LEVEL = 5e-4
"""Level of the test of each size."""

DOUBT_LEVEL = 0.1
"""Level below which the readings make a size doubtful, and a larger one is used instead: its upper
limit with as much confidence, which is far above what few coefficients show."""

BISECTIONS = 60
"""Steps, on a logarithmic scale, to find a size to rounding."""

TAIL = (1 - 0.9545) / 2
"""Probability of a small statistic below which a size is too large."""


@dataclass(frozen=True)
class SizeTest:
    """The size of a term compared with the readings.

    Attributes
    ----------
    name : str
        The term.
    given : float
        Its size, SI unit of the term; the largest one of a microscope.
    shown, allowed : float
        The size shown by the readings, and the largest that they allow: the upper one of two limits
        with a coverage of 95.45 % if they contradict the given size, the limit of `DOUBT_LEVEL` if
        they make it doubtful; otherwise the given size.
    statistic : float
        b' (C + size^2 1)^-1 b of all coefficients; `rank` on average.
    rank : int
        Number of their combinations determined by the readings.
    p_together : float
        Probability of as large a value if the size is right.
    p : float
        The same of whichever is the least likely: of all coefficients, or of a family of them.
    evidence : float
        Logarithm of how much likelier the readings are with the size that they show (ratio of
        marginal likelihoods); 0 if they do not make the given one doubtful.
    """

    name: str
    given: float
    shown: float
    allowed: float
    statistic: float
    rank: int
    p_together: float
    p: float
    evidence: float = 0.0

    @property
    def contradicted(self) -> bool:
        """Whether the readings rule out the size as too small."""
        return self.p < SIZE_LEVEL

    @property
    def raised(self) -> bool:
        """Whether the readings make the size doubtful, or rule it out: a larger one is used."""
        return self.p < DOUBT_LEVEL


def size_test(equations: TermEquations, right: np.ndarray, term: ModelTerm,
              noise: tuple[float, float]) -> SizeTest:
    """Return the test of one size, the other terms with their sizes or free.

    The test of all its coefficients, or of those of one family (`Block.families`): whichever
    contradicts the size more, at the level of all of them together.

    Parameters
    ----------
    equations : TermEquations
        The columns of all terms.
    right : float array (p,)
        Inner products c' W y of all columns with the readings, without coefficients subtracted.
    term : ModelTerm
        With a size.
    noise : tuple of float
        Noise of one grid reading, m, and its degrees of freedom.
    """
    columns = equations.columns.columns
    every = equations.rows([term.name])
    families = [every & np.array([column.component in family for column in columns])
                for family in term.block.families]
    whole, *parts = [_coefficients_test(equations, right, term, noise, rows=rows,
                                        among=1 + len(families))
                     for rows in (every, *families)]
    return replace(min((whole, *parts), key=lambda test: test.p), rank=whole.rank,
                   statistic=whole.statistic, p_together=whole.p_together)


def _coefficients_test(equations: TermEquations, right: np.ndarray, term: ModelTerm,
                       noise: tuple[float, float], *, rows: np.ndarray, among: int) -> SizeTest:
    """Return the test of a size by the coefficients `rows`, bool (p,), one of `among` tests."""
    sigma, dof = noise
    values, variance, of_size = _told(equations, right, rows, sigma)
    rank = len(values)

    def spread(size: float) -> np.ndarray:
        return np.diag(variance) + size**2 * of_size

    def statistic(size: float) -> float:
        return float(values @ np.linalg.solve(spread(size), values))

    if not rank:
        return SizeTest(term.name, term.size, term.size, term.size, 0.0, 0, 1.0, 1.0)
    found = statistic(term.size)
    p = float(fdtrc(rank, min(dof, MANY_DOF), found / rank))
    test = SizeTest(term.name, term.size, term.size, term.size, found, rank, p, min(1.0, among * p))
    if not test.raised:
        return test
    # b'b / (size^2 the smallest eigenvalue) is not below it
    beyond = np.sqrt(values @ values / np.linalg.eigvalsh(of_size)[0])

    def size_at(level: float) -> float:
        low, high = term.size, float(beyond / np.sqrt(level))
        for _ in range(BISECTIONS):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if statistic(middle) > level else (low, middle)
        return high

    tail = TAIL if test.contradicted else DOUBT_LEVEL
    shown, allowed = size_at(rank), size_at(float(chdtri(rank, 1 - tail)))
    wider = np.linalg.slogdet(spread(shown))[1] - np.linalg.slogdet(spread(term.size))[1]
    return replace(test, shown=shown, allowed=allowed,
                   evidence=float(found - statistic(shown) - wider) / 2)


def _told(equations: TermEquations, right: np.ndarray, rows: np.ndarray, sigma_m: float
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the estimates of coefficients taken as free.

    The determined combinations, scaled by the columns' norms, (r,), their variances from the
    noise, (r,), and their covariance for a largest size of 1, (r, r).
    """
    rest = ~rows
    prior = np.where(rest, np.sqrt(equations.prior(sigma_m)), 0.0)
    norm = np.hypot(equations.norm, prior)
    scaled = equations.unbiased / np.outer(norm, norm) + np.diag((prior / norm) ** 2)
    hidden = equations.untold(equations.free & rest)[rest]
    held = np.linalg.pinv(scaled[np.ix_(rest, rest)] + hidden @ hidden.T, hermitian=True,
                          rcond=1e-14) - hidden @ hidden.T
    couple, scores = scaled[np.ix_(rows, rest)] @ held, equations.unbiased_sums(right) / norm
    told_by = scaled[np.ix_(rows, rows)] - couple @ scaled[np.ix_(rest, rows)]
    size, vectors = np.linalg.eigh((told_by + told_by.T) / 2)
    told = size > equations.limit(rows)
    vectors, size = vectors[:, told], size[told]
    values = vectors.T @ (scores[rows] - couple @ scores[rest]) / size
    own = equations.columns.size[rows]
    turned = vectors * (norm[rows] * own / own.max())[:, None]
    return values, sigma_m**2 / size, turned.T @ turned


def size_tests(equations: TermEquations, right: np.ndarray, terms: Sequence[ModelTerm],
               noise: tuple[float, float]) -> tuple[SizeTest, ...]:
    """Return the tests of all sizes, raised ones first, in the order of their evidence.

    Each is tested with the preceding terms at the sizes that the readings allow, so that one term
    does not make others appear too small.

    Parameters
    ----------
    equations, right, noise
        As in `size_test`.
    terms : sequence of ModelTerm
        All terms.
    """
    found: list[SizeTest] = []
    sized = [term for term in terms if not term.free and equations.rows([term.name]).any()]
    if not np.isfinite(noise[0]):
        return ()
    while sized:
        tests = [size_test(equations, right, term, noise) for term in sized]
        failed = [test for test in tests if test.raised]
        if not failed:
            return (*found, *tests)
        worst = max(failed, key=lambda test: test.evidence)
        found.append(worst)
        sized = [term for term in sized if term.name != worst.name]
        equations = replace(equations, columns=equations.columns.scaled(
            worst.name, worst.allowed / worst.given))
    return tuple(found)


def unseen_by_term(equations: TermEquations) -> dict[str, int]:
    """Return, for each free term that is not separable from the stage, the modes that it hides.

    Terms that are not separable only in combination are all named, with the modes hidden together.
    """
    free = {column.term for column in equations.columns.columns if column.size == float("inf")}
    out = {}
    for name in blocks():
        if name in free:
            modes = equations.unseen(equations.rows([name])).shape[1]
            if modes:
                out[name] = modes
    together = equations.unseen(equations.free).shape[1]
    if together and not out:
        out = {name: together for name in blocks() if name in free}
    return out


def require_terms_told(equations: TermEquations, seen: Observability) -> None:
    """Raise NotIdentifiableError if free terms hide modes of the stage.

    Parameters
    ----------
    equations : TermEquations
        The terms.
    seen : Observability
        Observability without terms.
    """
    modes = equations.unseen(equations.free).shape[1]
    if not modes:
        return
    by_term = unseen_by_term(equations)
    texts = tuple(f"{name}: {count} mode{'s' * (count != 1)} of the stage look like it"
                  for name, count in by_term.items())
    advice = tuple(f"{name}: {block_of(name).cure}, or give it a size, as in {name}:SIZE"
                   for name in by_term)
    free = int(equations.free.sum())
    found = replace(seen, unknowns=seen.unknowns + free, rank=seen.rank + free - modes,
                    deficiency=seen.deficiency + modes, identifiable=False, modes=texts,
                    advice=advice)
    raise NotIdentifiableError(
        f"the readings do not separate {' and '.join(by_term)} from the stage "
        f"({modes} mode{'s' * (modes != 1)} undetermined): " + "; ".join(advice), found)

# SPDX-License-Identifier: Apache-2.0
"""The fit of the same readings with a finer map, and the sizes of terms that it leaves.

Between its nodes a map is a spline, and what a rougher stage has more looks like a bent or strained
plate. A term, or a size, that the readings show with the map alone, and no more with a spline of
twice as many intervals, explains nothing but the map (method section 12).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from selfcal_ros.estimation.joint.fit import fit
from selfcal_ros.estimation.joint.model_fit import ModelFit, equations_of, settled, squares
from selfcal_ros.estimation.joint.problem import Problem, noise_excess
from selfcal_ros.estimation.lattice.placed import MapSpline
from selfcal_ros.estimation.normal.placed import PlacedEquations, PlacedSystem
from selfcal_ros.estimation.terms.columns import TermColumns
from selfcal_ros.estimation.terms.equations import TermEquations, next_coefficients, score
from selfcal_ros.estimation.terms.sizes import SizeTest, size_tests
from selfcal_ros.model.artifact import Interpolation
from selfcal_ros.model.terms import ModelTerm

MAX_COEFFICIENTS = 31 * 31
"""Largest refined spline that is fitted: a few seconds of one processor."""


class FinerEquations(PlacedEquations):
    """Equations of a refined map, of which the readings may determine only a part."""

    @cached_property
    def told(self) -> float:
        """Real coefficients of the map that the readings determine."""
        return told_coefficients(self)

    @cached_property
    def known_sites(self) -> np.ndarray:
        """Nodes with readings near them, which are fitted whether they are known or not."""
        return (self.grid.components.of_site >= 0).reshape(self.grid.views.shape)

    @cached_property
    def rank_grid(self) -> int:
        """Rank of the grid readings, coefficients counted as far as they are determined."""
        return round(self.told) + 2 * int(self.grid.mark_read.sum()) + self.rank_schur


def told_coefficients(system: PlacedEquations) -> float:
    """Return the real coefficients of a map that the readings determine."""
    factor, n = system.grid.factor, system.grid.n_sites
    return 2 * (n - system.grid.vague * float(factor.inverse_diagonal().sum()))


def is_too_large(problem: Problem) -> bool:
    """Return whether a map has too many nodes for a finer one."""
    system = problem.system
    return isinstance(system, PlacedEquations) and (
        math.prod(system.grid.views.spline.refined.shape) > MAX_COEFFICIENTS)


def equations_left(grid: PlacedSystem) -> int:
    """Return the readings of a map beyond plate and misalignments: two numbers each."""
    return 2 * grid.n_readings - 2 * int(grid.mark_read.sum()) - (
        grid.n_misalignments - 7)


def is_untested(problem: Problem) -> bool:
    """Return whether no finer map can test the nodes of a map, if it has nodes of its own."""
    system = problem.system
    if not isinstance(system, PlacedEquations) or is_too_large(problem):
        return isinstance(system, PlacedEquations)
    views, left = system.grid.views, equations_left(system.grid)
    if views.spline.axes[0].degree == 1 or left > 2 * math.prod(views.spline.refined.shape):
        return False
    fine = PlacedSystem(views.poses, system.grid.weight, views.spline.refined)
    return left - told_coefficients(PlacedEquations(
        fine, system.angular, system.grid_index, system.angular_index)) < 1


def finer(model: ModelFit) -> ModelFit | None:
    """Return the fit of the same readings with a finer map, the coefficients as they are.

    With the refined map, or, of a bilinear one, with a bicubic that fits better: of its nodes, or
    refined. None on the lattice, for a map that is too large, or if no reading is left to test it.
    """
    system = model.problem.system
    if not isinstance(system, PlacedEquations) or is_too_large(model.problem):
        return None
    views = system.grid.views
    splines = [views.spline.refined]
    if views.spline.axes[0].degree == 1:
        smooth = MapSpline.of(views.artifact.field, Interpolation.BICUBIC)
        splines += [smooth, smooth.refined]
    fits = [fine for spline in splines if (fine := with_map(model, spline)) is not None
            and np.isfinite(fine.found.xy.residuals)]
    return min(fits, key=lambda fine: fine.found.xy.residuals, default=None)


def with_map(model: ModelFit, spline: MapSpline) -> ModelFit | None:
    """Return the fit of the same readings with another map and the same terms, in one step.

    None on the lattice, or if the readings leave no noise by which to weight the terms.
    """
    problem, system = model.problem, model.problem.system
    if not isinstance(system, PlacedEquations):
        return None
    grid = system.grid
    other = FinerEquations(PlacedSystem(grid.views.poses, grid.weight, spline, grid.rotations),
                           system.angular, system.grid_index, system.angular_index)
    flat = np.zeros((len(problem.conditions.rows), *other.grid.views.shape), dtype=complex)
    problem = replace(problem, system=other, places=None, residuals_xy=None,
                      conditions=replace(problem.conditions, slopes=flat))
    refitted = replace(model, problem=problem, found=fit(problem, model.y), reduced=None)
    if model.equations is None:
        return refitted
    weighted = np.isfinite(refitted.found.xy.sigma)
    return _with_terms(refitted, model.equations.columns) if weighted else None


def _with_terms(model: ModelFit, columns: TermColumns) -> ModelFit:
    """Return a fit with the coefficients of the terms fitted once more."""
    problem, found = model.problem, model.found
    equations = equations_of(problem, found, columns)
    now = score(equations, found.both_residuals, squares(problem, found),
                coefficients=model.coefficients)
    values = next_coefficients(equations, now, model.coefficients, sigma_m=found.xy.sigma,
                               inverse=equations.inverse(found.xy.sigma))
    y = np.where(problem.system.grid.read, model.y - columns.shapes.combined(
        values - model.coefficients), 0.0)
    found = fit(problem, y)
    return replace(model, found=found, y=y, coefficients=values,
                   equations=equations_of(problem, found, columns))


def fit_model(problem: Problem,
              check: Callable[[TermEquations], None] = lambda equations: None) -> ModelFit:
    """Return the joint least-squares solution of the whole model.

    A term's size that is too small would bend the map with nothing to show it: if the readings make
    it doubtful, the fit is repeated with the largest size that they allow. A term that all views
    share, or a turn of lines, comes first if it explains all by itself: marks that turn against
    lines as a microscope of another scale turns them are not plates that moved between both, nor
    bent ones.

    Parameters
    ----------
    problem : Problem
        Readings and model.
    check : callable
        Called with the equations of the terms before they are solved; may raise.

    Raises
    ------
    NotSettledError, InputError
        If the rotations do not settle, or a term needs what the readings do not separate.
    """
    model = settled(problem, check)
    sizes = _size_tests(model, problem.terms)
    if not any(test.raised for test in sizes):
        return replace(model, sizes=sizes)
    for term in problem.terms:
        first = term.block.shared or term.block.between
        alone = _size_tests(model, [term] if first else [])
        if any(test.contradicted for test in alone):
            simpler = settled(_raised(problem, alone), check)
            rest = _size_tests(simpler, [other for other in problem.terms if other is not term])
            if not any(test.contradicted for test in rest):
                sizes = (*alone, *rest)
                break
    return replace(settled(_raised(problem, sizes), check), sizes=sizes)


def _raised(problem: Problem, sizes: Sequence[SizeTest]) -> Problem:
    """Return the problem with the sizes that the readings allow where they make them doubtful."""
    allowed = {test.name: test.allowed for test in sizes if test.raised}
    return replace(problem, terms=tuple(
        term.scaled(allowed[term.name] / term.size) if term.name in allowed else term
        for term in problem.terms))


def _size_tests(model: ModelFit, terms: Sequence[ModelTerm]) -> tuple[SizeTest, ...]:
    """Return the tests of the sizes of terms; of one that only the map contradicts the finer's."""
    tests = _tests_of(model, terms)
    if not any(test.raised for test in tests) or (fine := finer(model)) is None:
        return tests
    instead = {test.name: test for test in _tests_of(fine, terms) if not test.raised}
    return tuple(instead.get(test.name, test) for test in tests)


def _tests_of(model: ModelFit, terms: Sequence[ModelTerm]) -> tuple[SizeTest, ...]:
    """Return the tests of the sizes of terms by one fit; none without a noise to test them by."""
    equations = model.equations
    if equations is None or equations.free.all():
        return ()
    scored = score(equations, model.found.both_residuals, squares(model.problem, model.found),
                   coefficients=model.coefficients)
    right = scored.total + equations.information @ model.coefficients
    noise, excess = model.found.xy, noise_excess(model.problem, model.found.residuals)
    return size_tests(equations, right, terms, (noise.sigma * math.sqrt(excess), noise.dof))

# SPDX-License-Identifier: Apache-2.0
"""The fit of the whole model: finite rotations and terms around the linear least squares.

A mark lies at R(phi) R^q (m + A + B) + t, with B the plate's own change in a view. The readings are
taken in the frame of the plate as it lies (`selfcal_ros.estimation.joint.problem.turned`), where
what is left of phi is small. What finite rotations add to the linear model there, and what the
terms make of the readings, are taken off with the last solution until it stands still. Every step
solves the same factored equations (Gauss-Newton).

The same readings are fitted with a finer map, which may leave other sizes of terms. Between its
nodes a map is a spline, and what a rougher stage has more looks like a bent or strained
plate. A term, or a size, that the readings show with the map alone, and no more with a spline of
twice as many intervals, explains nothing but the map (method section 12).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from selfcal_ros.blocks import Block, block_of
from selfcal_ros.errors import NotSettledError
from selfcal_ros.estimation.joint.problem import (
    DECLARED_DOF,
    NEGLIGIBLE,
    ROUNDING,
    JointFit,
    Moving,
    Problem,
    angular_part,
    fit,
    least_noise_rad,
    noise_excess,
    sigma_of,
)
from selfcal_ros.estimation.lattice.maps import MapSpline
from selfcal_ros.estimation.normal.angular import FLOOR, MAX_STEPS, ROUNDED
from selfcal_ros.estimation.normal.equations import PlacedEquations, PlacedSystem
from selfcal_ros.estimation.terms.columns import TermColumns, term_columns
from selfcal_ros.estimation.terms.equations import (
    Score,
    SizeTest,
    TermEquations,
    equations_of_columns,
    next_coefficients,
    residual_sums,
    score,
    size_tests,
)
from selfcal_ros.estimation.terms.visits import ViewVisits, without_noise
from selfcal_ros.model.artifact import Interpolation
from selfcal_ros.model.terms import ModelTerm

LATE, OF_NOISE_LATE = 20, 0.1
"""Steps after which rounding is all that moves, and the change, against its standard uncertainty,
that is none from then on: plates laid millimetres beside their places make the offsets, and their
rounding, as large. An iteration whose smallest change lies as many steps back goes in circles."""


@dataclass(frozen=True, eq=False)
class ModelFit:
    """A fit of the whole model.

    Attributes
    ----------
    problem : Problem
        As it was solved, with the noise that terms leave.
    fitted : JointFit
        Maps and misalignments, terms taken off.
    equations : TermEquations
        Equations of the terms.
    coefficients : float array (p,)
        Of the terms' columns.
    y : complex array (views, nx, ny)
        Deviations as the last linear step took them.
    sizes : tuple of SizeTest
        The test of every size. In place of one that the readings contradict the fit, and with it
        every uncertainty, has the largest that they allow.
    given : tuple of ModelTerm
        The terms with the sizes that were given, if larger ones are used.
    """

    problem: Problem
    fitted: JointFit
    equations: TermEquations
    coefficients: np.ndarray
    y: np.ndarray
    sizes: tuple[SizeTest, ...] = ()
    given: tuple[ModelTerm, ...] = ()

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the coefficients for unit noise of one grid reading, (p, p)."""
        return self.equations.inverse(self.fitted.xy.sigma)

    def scored(self, equations: TermEquations, coefficients: np.ndarray) -> Score:
        """Return the score of columns of which `coefficients` (p,) are taken off the readings."""
        return score(
            equations,
            self.fitted.both_residuals,
            squares(self.problem, self.fitted),
            coefficients=coefficients,
        )

    def visits_about_means(self) -> Iterator[tuple[int, ViewVisits, np.ndarray]]:
        """Yield row and visits of each view, and what they have more than the means of their marks.

        Complex (V,), plate frame, m, without the terms.
        """
        of_terms = self.equations.columns.at_visits(self.coefficients)
        n_marks = self.problem.system.grid.n_marks
        for row, visits in enumerate(self.problem.inputs.visits):
            if visits is not None:
                y = visits.y - of_terms[row]
                yield row, visits, visits.about_means(y[None], n_marks)[0]


def settled(problem: Problem, check: Callable[[TermEquations], None]) -> ModelFit:
    """Return the solution with the sizes as they are; arguments as `fit_model`."""
    state = _State(problem)
    check(state.equations)
    if not (problem.rigid or problem.terms or problem.moves):
        return state.finished()
    before = np.inf
    peak = float(np.abs(problem.grid.y).max())
    smallest = np.inf
    found_at = 0
    for number in range(MAX_STEPS):
        change = state.step()
        if change <= max(ROUNDED * state.largest_m, ROUNDING * peak):
            return state.finished()
        stuck = number > 2 and 2 * change > before
        small_share = NEGLIGIBLE if number < LATE else OF_NOISE_LATE
        if stuck and (change <= FLOOR or state.within_noise(small_share)):
            return state.finished()
        if change < smallest:
            smallest, found_at = change, number
        if peak < NEGLIGIBLE * change or number - found_at >= LATE:
            break
        before = change
    if problem.terms:
        free = " or ".join(
            str(term.name) for term in problem.terms if math.isinf(term.size)
        )
        raise NotSettledError(
            f"model {', '.join(str(term.name) for term in problem.terms)}",
            "the fit does not converge",
            "leave a term out" + (f", or give {free} a size" if free else ""),
        )
    raise NotSettledError(
        "misalignment model 'rigid'",
        "the rotations do not converge",
        "check the readings for misalignments of more than a few degrees",
    )


def equations_of(
    problem: Problem, fitted: JointFit, columns: TermColumns
) -> TermEquations:
    """Return the equations of columns about the estimate `fitted`."""
    noise = fitted.xy
    # identical repeats show a sensor's resolution; then no offset would count as noise
    shown = [
        sigma
        for sigma in (noise.declared, noise.repeats, noise.residuals)
        if sigma > FLOOR
    ]
    return equations_of_columns(
        problem.system,
        columns,
        fitted.inverse,
        ratio=fitted.ratio,
        half_width_m=problem.half_width_m,
        noise_m=min(shown, default=0.0),
    )


class _State:
    """State of the iteration."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.steps, self.theta = problem, 0, angular_part(problem)
        self.lines_read = problem.angular.y
        self.moving = Moving(problem)
        self.y = problem.grid.y
        self.fitted = fit(problem, self.y, self.theta)
        self.offset_steps = LATE
        self.moved_m = np.zeros(problem.system.size)
        self.changed = np.zeros_like(self.y)
        self.fell = self.rounds = False
        self.of_offsets = any(term.block.of_microscope for term in problem.terms)
        inputs = without_noise(problem.inputs, self.fitted.residuals)
        self._linearise(term_columns(inputs, problem.terms))
        self.coefficients = self.stepped = np.zeros(self.equations.n)

    @property
    def largest_m(self) -> float:
        """The largest misalignment, the turns of the frames included, m at the half width."""
        turned_m = self.problem.half_width_m * self.problem.turn_rad
        return float(np.abs([*self.fitted.parameters, *turned_m]).max())

    def _linearise(self, columns: TermColumns) -> None:
        """Set up the equations of the terms about the present solution."""
        self.linearised = self.fitted
        self.equations = equations_of(self.problem, self.fitted, columns)

    def _refresh(self) -> None:
        """Set up the equations again where visits, offsets or weights have changed."""
        if 0 < self.steps <= self.offset_steps and (
            self.of_offsets or self.problem.moves
        ):
            self._linearise(self._anew())
        elif self._is_stale:
            self._linearise(self.equations.columns)

    def _anew(self) -> TermColumns:
        """Return the columns for the present visits and noise-free offsets."""
        before = self.equations.columns
        inputs = without_noise(
            self.moving.inputs(self.fitted),
            self.fitted.residuals,
            before.at_visits(self.coefficients),
        )
        columns = term_columns(inputs, self.problem.terms)
        rows = columns.having(lambda block: block.of_microscope)
        effect = columns.shapes.combined(
            self.coefficients, rows
        ) - before.shapes.combined(self.coefficients, rows)
        if self.of_offsets and np.abs(effect).max() <= ROUNDED * self.largest_m:
            self.offset_steps = self.steps
        return columns

    @property
    def _is_stale(self) -> bool:
        """Whether the weights of angular readings differ from those in the equations."""
        now, then = self.fitted, self.linearised
        if len(self.equations.columns.lines.at) and (
            abs(now.ratio - then.ratio) > NEGLIGIBLE * then.ratio
        ):
            return True
        change = np.abs(now.inverse - then.inverse).max()
        return bool(change > NEGLIGIBLE * np.abs(then.inverse).max())

    def step(self) -> float:
        """Take one step; return the largest change of a misalignment or of a reading, m.

        The smaller of the two. Misalignments may move by rounding for ever where nothing depends
        on them: all rotations together, that of a view of lines alone. What is taken off the
        readings may where the misalignments take it up; not so what places of the stage change.
        """
        parameters = self.fitted.parameters
        y = self.y
        coefficients = self.coefficients
        if self.problem.terms:
            self._refresh()
        self.steps += 1
        if self.problem.terms:
            self._solve_terms()
        elif self.problem.moves:
            self.problem = replace(
                self.problem, repeats_xy=self.moving.repeats(self.fitted)
            )
        place_change = self.moving.change_of_readings(self.fitted.field)
        self.y = np.where(
            self.problem.system.grid.read,
            self.problem.grid.y - self._excess() - self._of_terms() - place_change,
            0.0,
        )
        self.fitted = fit(self.problem, self.y, self.theta)
        self.moved_m = np.abs(self.fitted.parameters - parameters)
        self.changed, self.stepped = self.y - y, self.coefficients - coefficients
        return max(
            min(float(self.moved_m.max()), float(np.abs(self.changed).max())),
            self.moving.change,
        )

    def within_noise(self, share: float) -> bool:
        """Return whether the last step was below a part of what the noise makes of it.

        Of a misalignment that the readings alone determine, and of a coefficient, that is its
        standard uncertainty; of a misalignment that the datum fixes, and of what else is taken off
        a reading, that of the mean of all readings of a view.
        """
        sigma, weight = self.fitted.xy.sigma, self.problem.grid.weight
        if not np.isfinite(sigma):
            return False
        of_view = sigma / np.sqrt(weight.reshape(len(weight), -1).sum(axis=1).max())
        spread = np.diag(self.fitted.inverse)
        determined = spread > ROUNDED * spread.max(initial=0.0)
        noise = np.where(
            determined, sigma * np.sqrt(np.where(determined, spread, 0.0)), of_view
        )
        still = bool((self.moved_m <= share * noise).all()) or (
            self._changed_besides_m <= share * of_view
            and self._terms_are_still(share * sigma)
        )
        return still and self.moving.change <= share * of_view

    @property
    def _changed_besides_m(self) -> float:
        """The largest change of a reading in the last step besides that of the terms, m."""
        return float(np.abs(self.changed + self._of_terms(by=self.stepped)).max())

    def _terms_are_still(self, part_m: float) -> bool:
        """Return whether the last step of each coefficient was below a part of its noise."""
        variances = np.maximum(
            np.diag(self.equations.inverse(self.fitted.xy.sigma)), 0.0
        )
        return bool((np.abs(self.stepped) <= part_m * np.sqrt(variances)).all())

    def finished(self) -> ModelFit:
        if self._is_stale:
            self._linearise(self.equations.columns)
        problem = replace(self.problem, inputs=self.moving.inputs(self.fitted))
        return ModelFit(problem, self.fitted, self.equations, self.coefficients, self.y)

    def _solve_terms(self) -> None:
        equations = self.equations
        now = score(
            equations,
            self.fitted.both_residuals,
            squares(
                self.problem, self.fitted, of_noise=False
            ),  # less those `_of_lines`
            coefficients=self.coefficients,
        )
        sums = residual_sums(equations, now)
        total, dof = _of_lines(
            self.problem, self.fitted, equations, equations.free_inverse @ now.total
        )
        if sums.dof_between - dof < DECLARED_DOF or total > sums.between:
            total, dof = 0.0, 0.0
        residuals = sigma_of(sums.between - total, sums.dof_between - dof)
        # the weight of nearly exact lines leaves nothing else
        rounded = residuals[0] == 0
        self.problem = replace(
            self.problem,
            residuals_xy=self.problem.residuals_xy
            if rounded or self._goes_round(residuals[0])
            else residuals,
            repeats_xy=sigma_of(sums.within, sums.dof_within)
            if sums.dof_within >= 1
            else self.problem.repeats_xy,
        )
        sigma = self.fitted.xy.sigma if np.isfinite(self.fitted.xy.sigma) else 0.0
        inverse = equations.inverse(sigma)
        self.coefficients = next_coefficients(
            equations, now, self.coefficients, sigma_m=sigma, inverse=inverse
        )
        lines = equations.columns.lines
        if len(lines.at):
            line_values = np.tensordot(
                self.coefficients[lines.at], lines.values, axes=1
            )
            columns_of_lines = equations.columns.having(
                lambda block: block.of_lines and not block.turns_lines
            )
            within = inverse[np.ix_(columns_of_lines, columns_of_lines)]
            dof = float(
                np.sum(
                    within
                    * equations.information[np.ix_(columns_of_lines, columns_of_lines)]
                )
            )
            angular = replace(self.problem.angular, y=self.lines_read - line_values)
            self.problem = replace(self.problem, angular=angular, dof_lines=dof)
            self.theta = angular_part(self.problem)

    def _goes_round(self, sigma_m: float) -> bool:
        """Return whether the noise grows again late, after it fell: lines count for it or not."""
        before = self.problem.residuals_xy
        if self.steps > LATE and before is not None:
            self.rounds |= self.fell and sigma_m > before[0]
            self.fell |= sigma_m < before[0]
        return self.rounds

    def _of_terms(
        self,
        trait: Callable[[Block], bool] = lambda block: True,
        by: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the effect of the terms with a trait on the readings, (views, nx, ny), m.

        Of their coefficients, or of other ones.
        """
        columns = self.equations.columns
        return columns.shapes.combined(
            self.coefficients if by is None else by, columns.having(trait)
        )

    def _excess(self) -> np.ndarray | float:
        """Return `Problem.excess` of the present solution."""
        return self.problem.excess(
            self.fitted.parameters,
            self.fitted.plate + self._of_terms(lambda block: block.of_plate),
            self.problem.system.grid.views.gather(self.fitted.field)
            + self._of_terms(lambda block: block.of_map),
        )


def squares(
    problem: Problem, fitted: JointFit, *, of_noise: bool = True
) -> tuple[float, float]:
    """Return the weighted squares of all residuals, m^2, and their degrees of freedom.

    Grid and angular readings together, as they share the rotations: angular residuals in units of
    the grid's, by the ratio with which they were fitted. If they are to tell the noise
    (`of_noise`), lines that have less than they are weighted with do not count.
    """
    system = problem.system
    total = system.grid.squares(fitted.residuals)
    dof = system.dof_grid
    if fitted.ratio > 0:
        shared = len(set(system.angular_index) & set(system.grid_index))
        dof += max(shared - 1, 0)
        least_rad = least_noise_rad(problem, fitted.xy.sigma)
        if not (of_noise and fitted.theta.sigma < least_rad):
            squares_rad = system.angular.squares(fitted.residuals_theta)
            total += fitted.ratio * problem.half_width_m**2 * squares_rad
            dof += system.dof_angular
    return total, dof


def _of_lines(
    problem: Problem, fitted: JointFit, equations: TermEquations, more: np.ndarray
) -> tuple[float, float]:
    """Return the part of lines in `squares` and their degrees of freedom, all columns free.

    The weight of lines is that of the grid's noise over theirs. If that noise contained their
    residuals, either would grow with the other wherever lines agree less well than marks do.

    Parameters
    ----------
    problem, fitted, equations : Problem, JointFit, TermEquations
        A solution, and the columns about it.
    more : float array (p,)
        Free coefficients of the columns less those of the solution.
    """
    if not fitted.ratio > 0:
        return 0.0, 0.0
    system = problem.system
    angular = problem.system.angular
    columns = equations.projected.of_lines(
        system, equations.columns.lines, problem.half_width_m
    )[1]
    weight = equations.line_weight * angular.weight
    rotations = (
        fitted.ratio
        * fitted.inverse[np.ix_(system.phi_at, system.phi_at)]
        * angular.schur
    )
    followed = (
        np.einsum("vk,pvk,qvk->pq", weight, columns, columns) * equations.free_inverse
    )
    residuals = fitted.residuals_theta - np.tensordot(more, columns, axes=1)
    return (
        float((weight * residuals**2).sum()),
        angular.n_readings - angular.rank - float(rotations.sum() + followed.sum()),
    )


class FinerEquations(PlacedEquations):
    """Equations of a refined map, of which the readings may determine only a part."""

    @cached_property
    def known_sites(self) -> np.ndarray:
        """Nodes with readings near them, which are fitted whether they are known or not."""
        return (self.grid.components.of_site >= 0).reshape(self.grid.views.shape)

    @cached_property
    def rank_grid(self) -> int:
        """Rank of the grid readings, coefficients counted as far as they are determined."""
        of_plate = 2 * int(self.grid.mark_read.sum())
        return round(self.determined_coefficients) + of_plate + self.rank_schur


def placed(problem: Problem) -> PlacedEquations | None:
    """Return the equations of a map with nodes of its own; None on the lattice."""
    return problem.system if isinstance(problem.system, PlacedEquations) else None


def finer(model: ModelFit) -> ModelFit | None:
    """Return the fit of the same readings with a finer map, the coefficients as they are.

    With the refined map, or, of a bilinear one, with a bicubic that fits better: of its nodes, or
    refined. None on the lattice, for a map that is too large, or if no reading is left to test it.
    """
    system = placed(model.problem)
    if system is None or system.grid.too_large_to_refine:
        return None
    views = system.grid.views
    splines = [views.spline.refined]
    if views.bilinear:
        smooth = MapSpline.of(views.artifact.field, Interpolation.BICUBIC)
        splines += [smooth, smooth.refined]
    fits = [
        fine
        for spline in splines
        if (fine := with_map(model, spline)) is not None
        and np.isfinite(fine.fitted.xy.residuals)
    ]
    return min(fits, key=lambda fine: fine.fitted.xy.residuals, default=None)


def with_map(model: ModelFit, spline: MapSpline) -> ModelFit | None:
    """Return the fit of the same readings with another map and the same terms, in one step.

    None on the lattice, or if the readings leave no noise by which to weight the terms.
    """
    problem = model.problem
    system = placed(model.problem)
    if system is None:
        return None
    grid = system.grid
    system_of_map = FinerEquations(
        PlacedSystem(
            grid.views.artifact, grid.views.poses, grid.weight, spline, grid.rotations
        ),
        system.angular,
        system.grid_index,
        system.angular_index,
    )
    flat = np.zeros(
        (len(problem.conditions.rows), *system_of_map.grid.views.shape), dtype=complex
    )
    problem = replace(
        problem,
        system=system_of_map,
        places=None,
        residuals_xy=None,
        conditions=replace(problem.conditions, slopes=flat),
    )
    refitted = replace(model, problem=problem, fitted=fit(problem, model.y))
    if not problem.terms:
        return refitted
    weighted = np.isfinite(refitted.fitted.xy.sigma)
    return _with_terms(refitted, model.equations.columns) if weighted else None


def _with_terms(model: ModelFit, columns: TermColumns) -> ModelFit:
    """Return a fit with the coefficients of the terms fitted once more."""
    problem, fitted = model.problem, model.fitted
    equations = equations_of(problem, fitted, columns)
    now = model.scored(equations, model.coefficients)
    values = next_coefficients(
        equations,
        now,
        model.coefficients,
        sigma_m=fitted.xy.sigma,
        inverse=equations.inverse(fitted.xy.sigma),
    )
    y = np.where(
        problem.system.grid.read,
        model.y - columns.shapes.combined(values - model.coefficients),
        0.0,
    )
    fitted = fit(problem, y)
    return replace(
        model,
        fitted=fitted,
        y=y,
        coefficients=values,
        equations=equations_of(problem, fitted, columns),
    )


def fit_model(
    problem: Problem, check: Callable[[TermEquations], None] = lambda equations: None
) -> ModelFit:
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
        first_sizes = _size_tests(model, [term] if first else [])
        if any(test.contradicted for test in first_sizes):
            simpler = settled(_raised(problem, first_sizes), check)
            other_sizes = _size_tests(
                simpler, [another for another in problem.terms if another is not term]
            )
            if not any(test.contradicted for test in other_sizes):
                sizes = (*first_sizes, *other_sizes)
                break
    return replace(
        settled(_raised(problem, sizes), check), sizes=sizes, given=problem.terms
    )


def _raised(problem: Problem, sizes: Sequence[SizeTest]) -> Problem:
    """Return the problem with the sizes that the readings allow where they make them doubtful.

    Lines and marks turn alike as far as the scales of their offsets are alike: where the size of
    one is doubtful, that of the other is, too.
    """
    larger = {test.name: test.allowed / test.given for test in sizes if test.raised}
    offsets = max(
        (factor for name, factor in larger.items() if block_of(name).of_offsets),
        default=1.0,
    )
    return replace(
        problem,
        terms=tuple(
            term
            if term.free
            else term.scaled(
                max(
                    larger.get(term.name, 1.0),
                    offsets if term.block.of_offsets else 1.0,
                )
            )
            for term in problem.terms
        ),
    )


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
    if equations.free.all():
        return ()
    now = model.scored(equations, model.coefficients)
    right = now.total + equations.information @ model.coefficients
    noise = model.fitted.xy
    excess = noise_excess(model.problem, model.fitted.residuals)
    return size_tests(
        equations, right, terms, (noise.sigma * math.sqrt(excess), noise.dof)
    )

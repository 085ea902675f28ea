# SPDX-License-Identifier: Apache-2.0
"""Search the residuals for unmodelled effects, and add bounds on them to the uncertainty.

A term that the readings show joins the model with the largest size that they allow (method
eq. 7.9), until they show no more. A cause that is no term (a slip, a single reading, a stage off
the sites) has an effect on the map, which enlarges its uncertainty.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.checks.wiring import BEYOND, BEYOND_DOUBT, LEAST_NOISE_M
from selfcal_ros.estimation.joint.model_fit import finer
from selfcal_ros.estimation.joint.solve import Solved, solve_joint
from selfcal_ros.estimation.normal.equations import FULL_SIZE, UNASKED_SITES
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.equations import SizeTest
from selfcal_ros.estimation.verdict.causes import (
    MAX_CAUSES,
    READING,
    SLIP,
    Explanation,
    OffSites,
    cause_of,
    find_explanations,
    fitted_term,
    line_cause,
    noisier_views,
    off_sites_cause,
    scatter_of_views,
    turned_too_far,
)
from selfcal_ros.estimation.verdict.reversal import reversal_of
from selfcal_ros.estimation.verdict.roughness import (
    adequacy_of,
    line_adequacy_of,
    maps_to_try,
)
from selfcal_ros.estimation.verdict.uncertainty import (
    Effect,
    difference,
    effect_of_field,
    enlargements,
)
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.findings import Cause, CauseDetails, Remedy
from selfcal_ros.model.kept import NOISE
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import ModelTerm, merged
from selfcal_ros.model.verdict import Enlargement, TermResult

ALWAYS_SITES = FULL_SIZE**2
"""Field up to which causes are always searched for; in a larger one only if a test fails."""

MATTERS = 0.1
"""Effect on the map, in standard uncertainties (rms), below which a cause that the readings
determine fully is ignored."""


@dataclass(eq=False)
class Search:
    """A search for causes: what was found, and the solution that allows for it.

    Attributes
    ----------
    solved : Solved
        The solution with the terms that the readings show.
    measurements, options : Measurements, Options
        Its readings, and how they were solved.
    causes : list of Cause
        The most likely first.
    effects : list of Effect
        Effects that enlarge the uncertainty beyond that of the solution.
    terms : list of str
        Terms whose size was enlarged, or that joined.
    bounded : bool
        Whether solution and effects cover all causes.
    """

    solved: Solved
    measurements: Measurements
    options: Options
    causes: list[Cause] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)
    terms: list[str] = field(default_factory=list)
    bounded: bool = True

    def add_shown(self, *, failed: bool) -> None:
        """Add terms while the readings show any; then bound the effects of all other causes."""
        explanations: list[Explanation] = []
        for _ in range(MAX_CAUSES + 1):
            explanations = _explanations(self.solved, failed=failed)
            first = [
                item
                for item in explanations
                if item.rank == 0 and item.name in blocks()
            ]
            if not first or not self._join(first):
                break
            failed = False
        for item in explanations:
            self._bound(item)
        if (line := line_cause(self.solved.joint, self.measurements)) is not None:
            self.causes.append(line)
            lines = self.measurements.artifact.angular_count
            most = abs(line.size) / np.sqrt(max(lines, 1))  # the error of a reading
            self.effects.append(
                Effect(
                    line.name,
                    np.zeros((2, *self.measurements.artifact.field.shape)),
                    np.full(lines, most),
                )
            )
        if not self.causes:
            self._noisy_views()

    def _join(self, first: list[Explanation]) -> bool:
        """Add the first of equally good explanations to the model; the others enlarge u.

        Return whether it joined.
        """
        inputs = self.solved.joint.problem.inputs
        names = [*self.terms, first[0].name]
        solved = self.solved_with([_hardly(n) for n in names])
        if solved is None or not any(
            test.name == first[0].name and test.contradicted
            for test in solved.joint.sizes
        ):
            return False
        for alternative in first[1:]:
            twin = self.solved_with(
                [_hardly(n) for n in (*self.terms, alternative.name)]
            )
            if twin is not None:
                self.effects.append(
                    difference(alternative.name, twin.result, solved.result)
                )
        self.causes += [cause_of(item, inputs) for item in first]
        self.solved, self.terms = solved, names
        self.causes[-len(first)] = cause_of(
            fitted_term(
                solved.joint, first[0].name, first[0].p, determined=first[0].determined
            ),
            inputs,
        )
        return True

    def _bound(self, item: Explanation) -> None:
        """Add a cause outside the model, with its effect on the map as far as determined."""
        model = self.solved.joint
        cause = cause_of(item, model.problem.inputs)
        if (
            cause.name in [named.name for named in self.causes]
            and cause.name in blocks()
        ):
            return
        self.causes.append(cause)
        self.bounded &= item.determined
        if item.map_change is not None and item.angle_change is not None:
            field = item.map_change.reshape(model.problem.system.grid.views.shape)
            self.effects.append(
                effect_of_field(
                    item.name, field, self.measurements.sense, item.angle_change
                )
            )

    def _noisy_views(self) -> None:
        """Add the views whose visits scatter more than those of the others.

        A node may depend on one view alone: a view noisier than assumed enlarges the uncertainty.
        """
        views = scatter_of_views(self.measurements, self.solved.joint)
        emap = self.solved.result.error_map
        noisy = noisier_views(views)
        largest = max(
            (sigma for name, sigma, _ in views if name in [c.view for c in noisy]),
            default=0,
        )
        if (ratio := largest / self.solved.xy.sigma) > 1:
            plate = self.solved.result.artifact_map
            more = np.sqrt(ratio**2 - 1)
            on_plate = None
            if plate.u_ax.size:
                on_plate = more * np.stack([plate.u_ax, plate.u_ay])
            self.effects.append(
                Effect(
                    NOISE,
                    more * np.nan_to_num(emap.u_xy),
                    np.zeros(len(emap.g_theta)),
                    on_plate,
                )
            )
        self.causes += sorted(noisy, key=lambda cause: cause.p)

    def add_raised_sizes(self) -> tuple[list[str], bool]:
        """Put the terms first whose sizes the readings contradict, or that are not plausible.

        Return their names, and whether something else explains the readings as well as one of them.
        """
        solved = self.solved
        raised = {
            str(test.name): _raised_cause(solved, test)
            for test in solved.joint.sizes
            if (test.contradicted or not _is_plausible(test))
            and test.name not in self.terms
        }
        scales = (
            self._either_scale()
            if any(block_of(name).of_offsets for name, cause in raised.items() if cause)
            else {}
        )
        raised = scales | {
            name: cause for name, cause in raised.items() if name not in scales
        }
        self.bounded &= not any(_beyond_u(solved, test) for test in solved.joint.sizes)
        between = any(block_of(name).between for name in raised)
        alike = bool(scales) or (between and self._as_a_microscope())
        self.causes[:0] = [cause for cause in raised.values() if cause is not None]
        names = [name for name, cause in raised.items() if cause is not None]
        self._allow_for_plates(names)
        return names, alike

    def _either_scale(self) -> dict[str, Cause | None]:
        """Return the scales of the offsets of marks and of lines as causes, each as the only one.

        Nothing if not each by itself explains what the readings show.
        """
        causes: dict[str, Cause | None] = {}
        for term in self.solved.joint.given:
            if term.block.of_offsets and not term.free:
                twin = self._with_wide(term)
                if twin is None:
                    return {}
                cause = cause_of(
                    fitted_term(twin.joint, term.name), twin.joint.problem.inputs
                )
                causes[str(term.name)] = replace(
                    cause, details=replace(cause.details, either=True)
                )
        return causes if len(causes) > 1 else {}

    def _with_wide(self, microscope: ModelTerm) -> Solved | None:
        """Return the solution with a term so wide that it need not share what it explains.

        None if there is none, or the readings contradict another size.
        """
        wider = microscope.scaled(
            max(BEYOND * microscope.block.plausible / microscope.size, 1.0)
        )
        twin = self.solved_with([wider])
        contradicted = twin is None or any(
            test.contradicted for test in twin.joint.sizes
        )
        return None if contradicted else twin

    def _as_a_microscope(self) -> bool:
        """Return whether a microscope of another scale explains the rotation of lines equally well.

        If so it is a cause as well, and its effect enlarges the uncertainty, unless that is small.
        """
        microscope = next(
            (
                term
                for term in self.options.model_terms(visits=True)
                if term.block.of_microscope and not term.free
            ),
            None,
        )
        twin = self._with_wide(microscope) if microscope else None
        if microscope is None or twin is None:
            return False
        fitted = fitted_term(twin.joint, microscope.name)
        effect = difference(str(microscope.name), twin.result, self.solved.result)
        if not _counts(
            replace(fitted, effect_m=rms(effect.xy), effect_rad=rms(effect.theta)),
            self.solved,
        ):
            return False
        cause = cause_of(fitted, twin.joint.problem.inputs)
        self.causes.append(cause)
        self.effects.append(effect)
        self.bounded &= not abs(cause.size) > max(
            microscope.size, microscope.block.plausible
        )
        return True

    def _allow_for_plates(self, raised: Collection[str]) -> None:
        """Add plates that differ as causes beside scales of offsets that explain no more.

        Scales of marks and lines that are wrong alike make a plate seem to shrink by E phi^2: where
        a plate lies turned by mrad, it may have grown instead.
        """
        for name in raised:
            if not (block_of(name).of_lines and block_of(name).of_offsets):
                continue
            twin = self.solved_with([ModelTerm(name, 0.0)])
            if twin is None:
                continue
            contradicted = [test for test in twin.joint.sizes if test.contradicted]
            plausible = [
                test
                for test in contradicted
                if block_of(test.name).of_plate and _is_plausible(test)
            ]
            if not contradicted or plausible != contradicted:
                continue
            self.causes += filter(
                None, (_raised_cause(twin, test) for test in contradicted)
            )
            self.effects.append(difference(name, twin.result, self.solved.result))

    def add_turned_lines(self) -> Cause | None:
        """Add that lines turn against marks as plates do, and return it; None if they do not."""
        solved = self.solved
        turned = turned_too_far(solved.joint, solved.result, self.measurements)
        if turned is not None:
            self.bounded = False
            if turned.name not in [cause.name for cause in self.causes]:
                self.causes.append(turned)
        return turned

    def add_roughness(self, *, advise: bool) -> None:
        """Add what maps with nodes of their own do not follow, of marks and of lines."""
        model = self.solved.joint
        for rough in filter(None, (adequacy_of(model), line_adequacy_of(model))):
            self.effects.append(rough.effect(self.solved.result))
            if (cause := rough.cause) is None:
                continue
            nodes = ""
            if advise and not rough.of_lines:
                nodes = self._better_map()
            remedies = (Remedy("map", nodes),) if nodes else ()
            # a map that cannot follow the stage makes single readings stand out
            less_likely = (
                place
                for place, other in enumerate(self.causes)
                if other.name in (READING, SLIP) and other.p > cause.p
            )
            self.causes.insert(
                next(less_likely, len(self.causes)), replace(cause, remedies=remedies)
            )

    def _better_map(self) -> str:
        """Return the first map (--map) with which nothing contradicts the readings; else empty."""
        return next(
            (
                text
                for text, readings in maps_to_try(self.measurements)
                if _uncontradicted(readings, self.options)
            ),
            "",
        )

    def add_reversal(self) -> None:
        """Add a reversal that differs from site to site, if it matters for the map."""
        result = self.solved.result
        reversal = reversal_of(self.solved.joint)
        if reversal is None:
            return
        effect = reversal.effect(result)
        if rms(effect.xy) > MATTERS * rms(result.error_map.u_xy):
            self.effects.append(effect)
            self.causes.append(reversal.cause(effect))

    def add_off_sites(self, off_sites: OffSites) -> None:
        """Add a stage off the sites: first if residuals show it, too."""
        place = 0 if off_sites.residuals_show_it else len(self.causes)
        self.causes.insert(place, off_sites.cause)
        lines = np.zeros(self.measurements.artifact.angular_count)
        self.effects.append(
            effect_of_field(
                off_sites.cause.name,
                off_sites.map_change,
                self.measurements.sense,
                lines,
            )
        )
        self.bounded &= off_sites.bounded

    def best_model(self) -> str | None:
        """Return the model with which these readings give a good map; None if there is none.

        Its terms are free, or have the sizes that the readings allow: of the two models, if nothing
        contradicts them, the one with the smaller uncertainty.
        """
        terms_used = {term.name: term for term in self.solved.joint.problem.terms}
        best = None
        least = np.inf
        for free in (True, False):
            terms = [
                ModelTerm(name) if free else terms_used[name].rounded_up
                for name in self.terms
            ]
            tried = replace(self.options, terms=merged(self.options.terms, terms))
            if (solved := _uncontradicted(self.measurements, tried)) is not None:
                emap = solved.result.error_map
                u = rms(emap.u_xy) + np.nan_to_num(rms(emap.u_g_theta))
                if u < least:
                    best = ",".join(map(str, tried.terms))
                    least = u
        return best

    def solved_with(self, terms: Collection[ModelTerm]) -> Solved | None:
        """Return the solution with further terms; None if there is none."""
        more = merged(self.options.terms, terms)
        return _solved(self.measurements, replace(self.options, terms=more))


def search_causes(
    solved: Solved,
    measurements: Measurements,
    options: Options,
    *,
    failed: bool,
    advise: bool = True,
) -> Search:
    """Search the residuals for effects that are not in the model.

    Parameters
    ----------
    solved : Solved
        A solution; without a joint fit there is no search.
    measurements, options : Measurements, Options
        Its readings, and how they were solved.
    failed : bool
        Whether another test failed.
    advise : bool
        Whether remedies are tried.
    """
    search = Search(solved, measurements, options)
    if options.causes is False or solved.model is None:
        return search
    contradicted = any(test.contradicted for test in solved.model.sizes)
    off_sites = (
        None
        if measurements.artifact.map_grid
        else off_sites_cause(solved.model, solved.result.error_map)
    )
    failed = failed or contradicted or off_sites is not None
    sites = solved.model.problem.system.grid.n_sites
    if solved.xy.sigma > LEAST_NOISE_M and is_searched(sites, options, failed=failed):
        search.add_shown(failed=failed)

    raised, alike = search.add_raised_sizes()
    turned = search.add_turned_lines()
    search.add_roughness(advise=advise)
    search.add_reversal()
    if off_sites is not None:
        search.add_off_sites(off_sites)
    plausible = all(map(_is_plausible, search.solved.joint.sizes))
    search.bounded &= plausible
    search.solved = _from_readings(search.solved, search.terms)
    search.terms = [*raised, *search.terms]

    if advise and search.causes:
        tried = search.terms and plausible and not alike
        model = search.best_model() if tried else None
        faulty = (
            *(name for name, block in blocks().items() if block.of_time),
            READING,
            *([turned.name] if turned else []),
        )
        search.causes = [
            _advised(cause, model, search.terms, faulty) for cause in search.causes
        ]
    return search


def _uncontradicted(measurements: Measurements, options: Options) -> Solved | None:
    """Return the solution of a model that nothing contradicts; None if it is not."""
    solved = _solved(measurements, options)
    if solved is None or solved.xy.contradicted or solved.theta.contradicted:
        return None
    again = search_causes(solved, measurements, options, failed=False, advise=False)
    return None if again.causes else solved


def _advised(
    cause: Cause, model: str | None, terms: Collection[str], faulty: Collection[str]
) -> Cause:
    """Return a cause with its remedies: a model that was tried, a view to measure again.

    Measuring again does not remove the causes `faulty`.
    """
    remedies = [*cause.remedies]
    if model is not None and cause.name in terms:
        remedies.append(Remedy("model", model))
    if cause.view and cause.name not in faulty:
        remedies.append(Remedy("view", cause.view))
    return replace(cause, remedies=tuple(remedies))


def _from_readings(solved: Solved, joined: Iterable[str]) -> Solved:
    """Return a solution in which joined terms have the source ``readings``."""
    joined = set(joined)

    def of(term: TermResult) -> TermResult:
        if term.name not in joined:
            return term
        return replace(
            term, size=term.size_used or term.size, size_used=None, source="readings"
        )

    result = solved.result
    model = replace(result.model, terms=tuple(of(term) for term in result.model.terms))
    return replace(solved, result=replace(result, model=model))


def is_searched(sites: int, options: Options, *, failed: bool) -> bool:
    """Return whether causes are searched for in a field of that many sites.

    Parameters
    ----------
    sites : int
        Number of sites.
    options : Options
        `causes` forces or forbids the search.
    failed : bool
        Whether another test failed.
    """
    if options.causes is False or sites > UNASKED_SITES:
        return False
    return failed or sites <= ALWAYS_SITES or bool(options.causes)


def _explanations(solved: Solved, *, failed: bool) -> list[Explanation]:
    """Return explanations of the residuals of a solution, the most likely first."""
    model = solved.joint
    for slips in (False, True):
        explanations = [
            item
            for item in find_explanations(model, slips=slips)
            if failed or _counts(item, solved)
        ]
        if not (explanations or failed):
            return []
    if not explanations or (fine := finer(model)) is None:
        return explanations
    names_in_finer_map = {item.name for item in find_explanations(fine, slips=True)}
    return [item for item in explanations if item.name in names_in_finer_map]


def _counts(explanation: Explanation, solved: Solved) -> bool:
    """Return whether an explanation matters for the map."""
    # one node may be far off, and the rest not
    if not explanation.determined or explanation.name == READING:
        return True
    emap = solved.result.error_map
    u = np.concatenate([emap.u_gx[emap.valid], emap.u_gy[emap.valid]])
    if not np.isfinite(u).any():
        return True
    return explanation.effect_m > MATTERS * rms(
        u
    ) or explanation.effect_rad > MATTERS * rms(emap.u_g_theta)


def _solved(measurements: Measurements, options: Options) -> Solved | None:
    """Return the solution; None if there is none."""
    try:
        return solve_joint(measurements, options)
    except (NotIdentifiableError, InputError):
        return None


def _hardly(name: str) -> ModelTerm:
    """Return a term of a size that readings which show it contradict."""
    return ModelTerm(name, block_of(name).undetected)


def _is_plausible(test: SizeTest) -> bool:
    """Return whether a machine may have a term of the size that the readings allow.

    Or of the one that is declared.
    """
    return test.allowed <= max(test.given, block_of(test.name).plausible)


def _raised_cause(solved: Solved, test: SizeTest) -> Cause | None:
    """Return a contradicted size of a term as a cause; None if it does not matter.

    A size that is not plausible is a fault, however little of it is seen in the map.
    """
    term, contributions, u_of_map = _effect_of(solved, test)
    # the part that no reading determines is in the uncertainty, as far as that is known
    little = bool(contributions) and all(
        contribution.u_rms < MATTERS * u_of_map[contribution.unit]
        for contribution in contributions
    )
    fitted = fitted_term(
        solved.joint,
        term.name,
        test.p,
        determined=little or test.rank == len(term.estimates),
    )
    if not _counts(fitted, solved) and _is_plausible(test):
        return None
    block = block_of(test.name)
    if (block.between or block.shared) and abs(
        (cause := cause_of(fitted, solved.joint.problem.inputs)).size
    ) > BEYOND * cause.u:
        return cause  # otherwise the readings do not determine which view or part it is
    largest = max(term.estimates, key=lambda e: abs(e.value))
    return Cause(
        name=str(test.name),
        size=abs(largest.value),
        u=largest.u,
        unit=largest.unit,
        p=test.p,
        view=largest.view,
        details=CauseDetails(given=test.given),
    )


def _beyond_u(solved: Solved, test: SizeTest) -> bool:
    """Return whether a term is surely there, and what no reading determines of it exceeds u."""
    term, contributions, u_of_map = _effect_of(solved, test)
    if not test.p_together < BEYOND_DOUBT or test.rank == len(term.estimates):
        return False
    return any(
        2 * contribution.u_rms**2 > u_of_map[contribution.unit] ** 2
        for contribution in contributions
    )


def _effect_of(
    solved: Solved, test: SizeTest
) -> tuple[TermResult, tuple[Enlargement, ...], dict[str, float]]:
    """Return the term of a test, what it contributes to u, and u of each map, by its unit."""
    term = next(term for term in solved.result.model.terms if term.name == test.name)
    emap = solved.result.error_map
    return (
        term,
        enlargements(solved.result, [term.name], []),
        {"m": rms(emap.u_xy), "rad": rms(emap.u_g_theta)},
    )

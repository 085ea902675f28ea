# SPDX-License-Identifier: Apache-2.0
"""Exact rank of a set of views, or of the marks that were read in them.

The rank does not depend on a tolerance for a large matrix. With misalignments known, it is a count
of graph components (`lattice.connectivity`); the misalignments add the rank of a matrix with
three rows per view, whose zeros and non-zeros are ten orders of magnitude apart (method eqs. 6.1,
6.2).

Unseen fields of the stage have two sources (method eq. 6.1): a component of sites and marks that no
closed path of readings turns leaves a vector free; and undetermined combinations of misalignments
move whole fields.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np

from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.normal.angular import GAP, AngularSystem, HarmonicSystem
from selfcal_ros.estimation.normal.equations import (
    FULL_SIZE,
    NormalEquations,
    planned_system,
    pseudo_inverse,
)
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.artifact import Artifact, default_map_grid
from selfcal_ros.model.findings import (
    AddViews,
    AddViewsOrFewerNodes,
    BendingX,
    BendingY,
    EveryField,
    Finding,
    GroupsOfLines,
    GroupsOfSites,
    HarmonicsUnseen,
    LineOffsets,
    LinesNeverVisited,
    MarksMissing,
    MarksNeverRead,
    Nonorthogonality,
    PeriodicFields,
    PeriodicLines,
    RotationSymmetric,
    ScaleDifference,
    SitesNeverVisited,
    UndeterminedFields,
)
from selfcal_ros.model.result import Observability
from selfcal_ros.model.view import Plan, View, with_sub_views

DATUM_ROWS = 7
"""Stage translation, rotation, magnification; plate translation, rotation (Hu 5, 11)."""

DETERMINED = 0.5
"""Part of the sites of a field, or of the images of a cell, without which there are too few."""

NARROW = 5
"""Smallest number of sites across a reduced field."""


def plan_observability(plan: Plan) -> Observability:
    """Return the observability of the plan if every mark in the field is read."""
    system = planned_system(plan.artifact, plan.views)
    return full_observability(system, plan.artifact, plan.views)


@lru_cache
def identifies(artifact: Artifact, views: tuple[View, ...]) -> bool:
    """Return whether views determine the whole map if every mark in the field is read.

    For searches: no advice, no matrix if the count of components already says no, and that of the
    middle of a large field if it determines all misalignments. Every fit of readings of which some
    are missing asks for the same views.
    """
    system = planned_system(artifact, views)
    if artifact.map_grid is not None:
        return _nodes_known(system)
    components = system.grid.components
    if (
        components.balanced.any()
        or min(components.of_site.min(), components.of_mark.min()) < 0
    ):
        return False
    middle = smaller(Plan("", artifact, views), FULL_SIZE)
    if middle.artifact != artifact and not deficiency(
        planned_system(middle.artifact, views)
    ):
        return True  # further readings can only add
    return deficiency(system) == 0


def smaller(plan: Plan, size: int) -> Plan:
    """Return the plan on a field of at most `size` sites per side, with the same turns and shifts.

    The field keeps its proportions, on which the uncertainty of a long field depends, and sides of
    even or odd numbers, and is large enough for the plan's own shifts. A list of marks remains as
    it is, and so does a plate stepped over a map that is wider: its shifts need all of it.
    """
    artifact = plan.artifact
    if artifact.marks or max(artifact.shape) <= size or artifact.is_stepped:
        return plan
    reach = [
        max(map(abs, view.translation_m)) / plan.artifact.grid_pitch_m
        for view in with_sub_views(plan.views)
    ]
    # a plan to be searched has no views yet
    room = 2 * round(max(reach, default=0)) + 3
    share = min(1.0, max(size, room) / max(plan.artifact.shape))
    nx, ny = (
        max(
            2 * round((n * share - n % 2) / 2) + n % 2,
            min(n, max(room, NARROW) + 1 - n % 2),
        )
        for n in plan.artifact.shape
    )
    plate = Artifact(
        nx,
        plan.artifact.grid_pitch_m,
        plan.artifact.angular_count,
        0 if nx == ny else ny,
        harmonics=plan.artifact.harmonics,
    )
    grid = plan.artifact.map_grid
    return replace(
        plan,
        artifact=plate
        if grid is None
        else replace(
            plate,
            map_grid=replace(default_map_grid(plate), interpolation=grid.interpolation),
        ),
    )


def deficiency(system: NormalEquations) -> int:
    """Return the number of undetermined parameters of map, plate and misalignments."""
    return (
        unknowns_of(system) - system.rank_grid - DATUM_ROWS + angular_deficiency(system)
    )


def unknowns_of(system: NormalEquations) -> int:
    """Return the number of parameters of map, plate and misalignments."""
    grid = system.grid
    return 2 * (grid.n_sites + grid.n_marks) + grid.n_misalignments


def full_observability(
    system: NormalEquations, artifact: Artifact, views: Iterable[View]
) -> Observability:
    """Return rank and deficiency over all sites, marks and lines of the artifact.

    Parameters
    ----------
    system : NormalEquations
        The readings.
    artifact : Artifact
        The plate.
    views : iterable of View
        The views behind the readings, for the advice.
    """
    if artifact.map_grid is not None:
        return _placed_observability(system, artifact, tuple(views))
    unseen = deficiency(system)
    return Observability(
        system.rank_grid + DATUM_ROWS,
        unknowns_of(system),
        unseen,
        unseen == 0,
        advice=advice_for(artifact, views) if unseen else (),
    )


def angular_deficiency(system: NormalEquations) -> int:
    """Return the number of unseen modes of the angular map, apart from its free constant.

    If no angular view shares its rotation with a grid view, the constant of the plate's lines is
    free as well: a datum of the plate, which does not affect the stage's map.
    """
    angular = system.angular
    if not angular.n_views:
        return 0
    turns = max(system.nullity - (3 * system.grid.n_views - system.rank_schur), 0)
    if system.apart:
        turns = max(turns - 1, 0)
    return angular.n_unknowns - angular.rank - 1 + turns


def measured_observability(
    system: NormalEquations, artifact: Artifact, views: tuple[View, ...]
) -> Observability:
    """Return the observability of the marks that were read.

    If the views would identify the stage and only marks are missing, the determined sites
    suffice if they are at least half of the field: rank and unknowns then count these alone.

    Parameters
    ----------
    system : NormalEquations
        The readings.
    artifact : Artifact
        The plate.
    views : tuple of View
        The views that were read.
    """
    return with_unchecked(_measured_observability(system, artifact, views), system)


def with_unchecked(
    observability: Observability, system: NormalEquations
) -> Observability:
    """Return the observability with the counts of unchecked sites and lines."""
    return (
        observability
        if not observability.identifiable
        else replace(
            observability,
            unchecked_sites=int(system.unchecked_sites.sum()),
            unchecked_lines=int(system.unchecked_lines.sum()),
        )
    )


def _measured_observability(
    system: NormalEquations, artifact: Artifact, views: tuple[View, ...]
) -> Observability:
    read = _as_read(system, views)
    full = full_observability(system, artifact, read)
    if full.identifiable:
        return full
    if artifact.map_grid is not None or not identifies(artifact, read):
        return full
    sites, lines = system.known_sites, system.known_lines
    if sites.mean() < DETERMINED or (len(lines) and lines.mean() < DETERMINED):
        missing = MarksMissing(
            sites=int(sites.sum()),
            of_sites=sites.size,
            lines=int(lines.sum()),
            of_lines=len(lines),
        )
        return Observability(
            full.rank, full.unknowns, full.deficiency, False, advice=(missing,)
        )
    n_determined = 2 * int(sites.sum() + system.known_marks.sum())
    n_determined += int(system.known_views[: 3 * system.grid.n_views].sum())
    n_determined -= system.grid.differences.shape[1]
    return Observability(n_determined, n_determined, 0, True)


def _nodes_known(system: NormalEquations) -> bool:
    """Return whether views at any pose determine at least half of the map's nodes, and the lines.

    Nothing separates the modes that they determine badly from those that they do not determine, so
    that each node counts by its uncertainty (method, views at any pose).
    """
    return bool(
        _has_enough_readings(system)
        and not system.hides_fields
        and system.known_sites.mean() >= DETERMINED
        and angular_deficiency(system) == 0
    )


def _has_enough_readings(system: NormalEquations) -> bool:
    """Return whether readings are left for half of the nodes, one for each: the count says it."""
    grid = system.grid
    of_marks = 0 if grid.known_plate else np.count_nonzero(grid.read.any(axis=0))
    return bool(grid.n_readings - of_marks >= DETERMINED * grid.n_sites)


def _placed_observability(
    system: NormalEquations, artifact: Artifact, views: tuple[View, ...]
) -> Observability:
    n_known = int(system.known_sites.sum()) if _has_enough_readings(system) else 0
    grid = system.grid
    if _nodes_known(system):
        n_determined = (
            2 * (n_known + int(system.known_marks.sum())) + grid.n_misalignments
        )
        return Observability(n_determined, n_determined, 0, True)
    missing = len(system.loose_modes) or 2 * (grid.n_sites - n_known)
    missing += angular_deficiency(system)
    advice = advice_for(artifact, views) if n_known < DETERMINED * grid.n_sites else ()
    return Observability(
        unknowns_of(system) - missing,
        unknowns_of(system),
        max(missing, 1),
        False,
        advice=advice,
    )


def _as_read(system: NormalEquations, views: tuple[View, ...]) -> tuple[View, ...]:
    """Return the views with only the kinds of marks that were read."""
    return tuple(
        View(
            view.name,
            view.rotation_rad,
            view.translation_m,
            i in system.grid_index,
            i in system.angular_index,
        )
        for i, view in enumerate(views)
        if i in system.grid_index or i in system.angular_index
    )


def advice_for(artifact: Artifact, views: Iterable[View]) -> tuple[Finding, ...]:
    """Return the views that a deficient plan lacks: a quarter turn, a shift, a line."""
    views = tuple(views)
    poses = [view.pose for view in views if view.grid]
    turned, shifted, _ = _usual_views(artifact)
    missing = []
    if len({round((pose.turn_rad / math.pi) % 1, 6) % 1 for pose in poses}) < 2:
        missing.append(turned)
    if (
        len(
            {
                (
                    round(x / artifact.grid_pitch_m, 3),
                    round(y / artifact.grid_pitch_m, 3),
                )
                for x, y in (pose.shift_m for pose in poses)
            }
        )
        < 2
    ):
        missing.append(shifted)
    if any(view.angular for view in views) and artifact.angular_count:
        missing += _missing_lines(
            artifact, [v.on_stage(artifact).turn_lines or 0 for v in views if v.angular]
        )
    return tuple(AddViews(views=(view,), plate=artifact) for view in missing) or (
        _tried(artifact, views),
    )


def _usual_views(artifact: Artifact) -> tuple[View, View, View]:
    """Return a quarter turn, on the lattice, and a shift by one pitch along X and along Y."""
    pitch = artifact.grid_pitch_m
    quarter_shift_m = artifact.quarter_shift * artifact.grid_pitch_m
    lines = artifact.angular_count > 0
    turned = lines and artifact.angular_count % 4 == 0
    return (
        View("", math.pi / 2, (quarter_shift_m, quarter_shift_m), True, turned),
        View("", 0.0, (pitch, 0.0), True, lines),
        View("", 0.0, (0.0, pitch), True, lines),
    )


def _tried(artifact: Artifact, views: tuple[View, ...]) -> AddViews:
    """Return the first single view, by trial, that cures the plan."""
    turned, along_x, along_y = usual = _usual_views(artifact)
    if artifact.map_grid is not None:
        return AddViewsOrFewerNodes(views=usual, plate=artifact)
    again = View("", 0.0, (0.0, 0.0), True, artifact.angular_count > 0)
    for more in (along_y, along_x, turned, again):
        if identifies(artifact, (*views, more)):
            return AddViews(views=(more,), plate=artifact)
    return AddViews(views=usual, plate=artifact)


def _missing_lines(artifact: Artifact, turns: list[float]) -> list[View]:
    """Return the view of lines that is missing, if one is; turns in lines."""
    count = artifact.angular_count
    if artifact.harmonics:
        lacks = HarmonicSystem(
            tuple(turns), np.ones((len(turns), count)), artifact.harmonics
        )
        best = best_turn_deg(np.array(turns) * (2 * np.pi / count), artifact.harmonics)
        return [View("", math.radians(best), grid=False)] if lacks.missed else []
    turns_between = [round(turn - turns[0]) for turn in turns]
    return (
        [View("", 2 * math.pi / count, grid=False)]
        if math.gcd(count, *turns_between) > 1
        else []
    )


def best_turn_deg(turns_rad: np.ndarray, harmonics: int) -> int:
    """Return the turn, in whole degrees, of the further view that adds most to a Fourier map."""
    of_turns = np.exp(1j * np.outer(turns_rad, np.arange(1, harmonics + 1)))
    number = len(turns_rad)
    turns_deg = np.arange(1, 180)
    more = of_turns.sum(axis=0) + np.exp(
        1j * np.outer(np.radians(turns_deg), np.arange(1, harmonics + 1))
    )
    # information on each, in 2 / K
    information = number + 1 - np.abs(more) ** 2 / (number + 1)
    return int(turns_deg[(1 / np.maximum(information, 1e-12)).sum(axis=1).argmin()])


def is_unseen(system: NormalEquations, field: np.ndarray) -> bool:
    """Return whether a stage error can be compensated by a plate error and misalignments.

    Parameters
    ----------
    system : NormalEquations
        The readings.
    field : complex array (nx, ny)
        Stage error Gx + i Gy.
    """
    grid = system.grid
    y = grid.views.gather(field) * grid.read
    residual = grid.centred(y) * grid.read
    total = grid.squares(residual)
    scale = grid.squares(y)
    right = np.zeros(system.size)
    right[: 3 * grid.n_views] = grid.right_side(y)[1]
    block = np.zeros((system.size, system.size))
    block[: len(grid.block), : len(grid.block)] = grid.block
    if system.angular.n_views:
        # the angular lines relate the rotations as far as they were read
        weight = system.grid_scale / system.angular_scale
        block[np.ix_(system.phi_at, system.phi_at)] += weight * system.angular.schur
        block = grid.tied(block)
    explained = (
        right @ pseudo_inverse(*np.linalg.eigh(block), system.grid_scale) @ right
    )
    return bool(total - explained <= GAP * scale)


def unseen_modes(system: NormalEquations) -> Iterator[Finding]:
    """Yield the families of stage errors that the readings cannot tell from errors of the plate."""
    grid, modes = system.grid, system.loose_modes
    if grid.n_views > 1:
        yield from _known_families(system)
    if len(modes):
        yield UndeterminedFields(count=len(modes))
    yield from _component_family(grid)
    missing = (grid.components.of_site < 0).reshape(grid.views.shape)
    if missing.any():
        yield SitesNeverVisited(
            count=int(missing.sum()), first=_sites(missing, grid)[0]
        )
    if n := int((grid.components.of_mark < 0).sum()):
        yield MarksNeverRead(count=n)
    if system.angular.n_views:
        yield from _angular_families(system.angular)


def _sites(chosen: np.ndarray, grid: GridSystem) -> tuple[tuple[int, ...], ...]:
    """Return the numbers (m, n) of chosen sites."""
    numbers = np.argwhere(chosen) - np.array(grid.views.shape) // 2
    return tuple(map(tuple, numbers.tolist()))


def _known_families(system: NormalEquations) -> Iterator[Finding]:
    """Yield the unseen fields among the named ones."""
    z = system.grid.views.z_sites
    x, y = z.real, z.imag
    fields: tuple[tuple[Finding, np.ndarray], ...] = (
        (Nonorthogonality(), y + 1j * x),
        (ScaleDifference(), x - 1j * y),
        (BendingX(), x * y - 0.5j * x**2),
        (BendingY(), 0.5 * y**2 - 1j * x * y),
    )
    for family, field in fields:
        if is_unseen(system, field):
            yield family


def _component_family(grid: GridSystem) -> Iterator[Finding]:
    """Yield the family of vectors left free by balanced components, unless one spans all."""
    components = grid.components
    free = np.flatnonzero(components.balanced)
    if len(free) < 2 and not (len(free) == 1 and len(components.balanced) > 1):
        return
    label = np.where(
        (components.of_site >= 0) & np.isin(components.of_site, free),
        components.of_site,
        -1,
    )
    yield _shape_of(grid, label.reshape(grid.views.shape), n=len(free))


def _shape_of(grid: GridSystem, label: np.ndarray, *, n: int) -> Finding:
    """Return the pattern of the free components on the field."""
    shifts = {(pose.a, pose.b) for pose in grid.views.poses}
    turns = sorted({(pose.q - grid.views.poses[0].q) % 4 for pose in grid.views.poses})
    if len(grid.views.poses) == 1:
        return EveryField()
    for axis, lines in ((0, "rows"), (1, "columns")):
        first = np.take(label, [label.shape[axis] // 2], axis=axis)
        if (label == first).all():
            return LineOffsets(lines=lines, opposite=len(turns) > 1)
    beside_datum = 2 * n - 2  # rotation and scale, or the translations
    if len(shifts) == 1:
        return RotationSymmetric(
            half=not any(t % 2 for t in turns), numbers=beside_datum
        )
    if period := _period(label):
        return PeriodicFields(period=period, numbers=beside_datum)
    numbers, sizes = np.unique(label[label >= 0], return_counts=True)
    smallest = numbers[np.argmin(sizes)]
    return GroupsOfSites(count=n, smallest=_sites(label == smallest, grid))


def _period(label: np.ndarray) -> tuple[int, int] | None:
    """Return the smallest period of the components along x and y, None if there is none."""
    out = []
    for axis in (0, 1):
        size = label.shape[axis]
        periods = [
            p
            for p in range(1, size // 2 + 1)
            if np.array_equal(
                np.take(label, range(p, size), axis=axis),
                np.take(label, range(size - p), axis=axis),
            )
        ]
        if not periods:
            return None
        out.append(periods[0])
    return (out[0], out[1]) if max(out) > 1 else None


def _angular_families(angular: AngularSystem) -> Iterator[Finding]:
    """Yield the unseen modes of the angular map."""
    if isinstance(angular, HarmonicSystem):
        if angular.missed:
            yield HarmonicsUnseen(
                harmonics=tuple(map(int, angular.missed)), turned=angular.n_views > 1
            )
        return
    components = angular.components
    n = len(components.balanced)
    lines = np.arange(len(components.of_site))
    if n > 1 and np.array_equal(components.of_site, components.of_site[lines % n]):
        yield PeriodicLines(period=n, of=len(lines))
    elif n > 1:
        yield GroupsOfLines(count=n)
    if missing := int((components.of_site < 0).sum()):
        yield LinesNeverVisited(count=missing)


def equivalent_key(artifact: Artifact, views: Iterable[View]) -> tuple:
    """Return a key that is the same for equivalent plans, from their turns and shifts.

    Turning stage and plate together renames sites and marks; so does mirroring both; turning the
    plate in all views renames the marks. A field that is not square has half of these symmetries.
    The uncertainty of XY is the same; that of theta need not be. A list of marks has no symmetry.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : iterable of View
        Views of grid marks.
    """
    square = artifact.shape[0] == artifact.shape[1]
    listed = artifact.marks is not None
    forms_of_views = []
    for view in views:
        turn = round(view.pose.turn_rad / (math.pi / 2), 9) % 4
        shift = complex(
            *(round(step / artifact.grid_pitch_m, 6) for step in view.pose.shift_m)
        )
        forms_of_views.append(_forms(turn, shift, square=square, listed=listed))
    return min(tuple(sorted(form)) for form in zip(*forms_of_views, strict=True))


@lru_cache(maxsize=1024)
def _forms(
    turn: float, shift: complex, *, square: bool, listed: bool
) -> tuple[tuple[float, float, float], ...]:
    """Return a view's turn and shift in each of the symmetries: thousands of plans share it."""
    if listed:
        return ((turn, shift.real + 0.0, shift.imag + 0.0),)
    turns = range(0, 4, 1 if square else 2)
    forms = []
    for mirror, stage, plate in product((False, True), turns, turns):
        q, by = (-turn, shift.conjugate()) if mirror else (turn, shift)
        by = by * complex(PHASES[stage])
        forms.append(((q + plate) % 4, by.real + 0.0, by.imag + 0.0))
    return tuple(forms)

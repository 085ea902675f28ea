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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from selfcal_ros.estimation.lattice.connectivity import Components
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.normal.angular import AngularSystem, HarmonicSystem
from selfcal_ros.estimation.normal.equations import (
    Memo,
    NormalEquations,
    planned_system,
    pseudo_inverse,
)
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import Observability
from selfcal_ros.model.view import Plan, View
from selfcal_ros.units import MM_PER_M

DATUM_ROWS = 7
"""Stage translation, rotation, magnification; plate translation, rotation (Hu 5, 11)."""

DETERMINED = 0.5
"""Fraction of the field's sites that must be determined for a map."""


_measured: Memo[tuple[Artifact, tuple[View, ...]], Observability] = Memo()


def plan_observability(plan: Plan) -> Observability:
    """Return the observability of the plan if every mark in the field is read."""
    system = planned_system(plan.artifact, plan.views, rank_only=True)
    return full_observability(system, plan.artifact, plan.views)


def identifies(artifact: Artifact, views: Sequence[View]) -> bool:
    """Return whether views determine the whole map if every mark in the field is read.

    For searches: no advice, and no matrix if the count of components already says no.
    """
    system = planned_system(artifact, views, rank_only=True)
    if artifact.map_grid is not None:
        return _nodes_known(system)
    parts = system.grid.components
    if parts.balanced.any() or min(parts.of_site.min(), parts.of_mark.min()) < 0:
        return False
    return deficiency(system) == 0


def deficiency(system: NormalEquations) -> int:
    """Return the number of undetermined parameters of map, plate and misalignments."""
    return unknowns_of(system) - system.rank_grid - DATUM_ROWS + angular_deficiency(system)


def unknowns_of(system: NormalEquations) -> int:
    """Return the number of parameters of map, plate and misalignments."""
    grid = system.grid
    return 2 * (grid.n_sites + grid.n_marks) + grid.n_misalignments


def full_observability(system: NormalEquations, artifact: Artifact,
                       views: Iterable[View]) -> Observability:
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
    return Observability(system.rank_grid + DATUM_ROWS, unknowns_of(system), unseen, unseen == 0,
                         advice=advice_for(artifact, views) if unseen else ())


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


def measured_observability(system: NormalEquations, artifact: Artifact,
                           views: tuple[View, ...]) -> Observability:
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
    return _measured.get(system, (artifact, views), lambda: with_unchecked(
        _measured_observability(system, artifact, views), system))


def with_unchecked(seen: Observability, system: NormalEquations) -> Observability:
    """Return the observability with the counts of unchecked sites and lines."""
    return seen if not seen.identifiable else replace(
        seen, unchecked_sites=int(system.unchecked_sites.sum()),
        unchecked_lines=int(system.unchecked_lines.sum()))


def _measured_observability(system: NormalEquations, artifact: Artifact,
                            views: tuple[View, ...]) -> Observability:
    read = _as_read(system, views)
    full = full_observability(system, artifact, read)
    if full.identifiable:
        return full
    if artifact.map_grid is not None or not identifies(artifact, read):
        return full
    sites, lines = system.known_sites, system.known_lines
    if sites.mean() < DETERMINED or (len(lines) and lines.mean() < DETERMINED):
        text = (f"read the missing marks: only {int(sites.sum())} of {sites.size} sites and "
                f"{int(lines.sum())} of {len(lines)} lines are determined")
        return Observability(full.rank, full.unknowns, full.deficiency, False, advice=(text,))
    kept = 2 * int(sites.sum() + system.known_marks.sum())
    kept += int(system.known_views[:3 * system.grid.n_views].sum())
    kept -= system.grid.differences.shape[1]
    return Observability(kept, kept, 0, True)


def _nodes_known(system: NormalEquations) -> bool:
    """Return whether views at any pose determine at least half of the map's nodes, and the lines.

    Nothing separates the modes that they determine badly from those that they do not determine, so
    that each node counts by its uncertainty (method, views at any pose).
    """
    return bool(not system.hides_fields and system.known_sites.mean() >= DETERMINED
                and angular_deficiency(system) == 0)


def _placed_observability(system: NormalEquations, artifact: Artifact,
                          views: tuple[View, ...]) -> Observability:
    known, grid = int(system.known_sites.sum()), system.grid
    if _nodes_known(system):
        kept = 2 * (known + int(system.known_marks.sum())) + grid.n_misalignments
        return Observability(kept, kept, 0, True)
    missing = len(system.loose_modes) or 2 * (grid.n_sites - known)
    missing += angular_deficiency(system)
    advice = advice_for(artifact, views) if known < DETERMINED * grid.n_sites else ()
    return Observability(unknowns_of(system) - missing, unknowns_of(system), max(missing, 1), False,
                         advice=advice)


def _as_read(system: NormalEquations, views: tuple[View, ...]) -> tuple[View, ...]:
    """Return the views with only the kinds of marks that were read."""
    return tuple(View(view.name, view.rotation_rad, view.translation_m,
                      i in system.grid_index, i in system.angular_index)
                 for i, view in enumerate(views)
                 if i in system.grid_index or i in system.angular_index)


def advice_for(artifact: Artifact, views: Iterable[View]) -> tuple[str, ...]:
    """Return advice on the missing views of a deficient plan: a quarter turn, a shift, a line."""
    views = tuple(views)
    poses = [view.pose for view in views if view.grid]
    advice, step = [], one_pitch(artifact)
    if len({round((pose.turn_rad / math.pi) % 1, 6) % 1 for pose in poses}) < 2:
        advice.append(f"add a view {quarter_turn(artifact)}")
    if len({(round(x / artifact.grid_pitch_m, 3), round(y / artifact.grid_pitch_m, 3))
            for x, y in (pose.shift_m for pose in poses)}) < 2:
        advice.append(f"add a view shifted by {step} along X")
    if any(view.angular for view in views) and artifact.angular_count:
        advice += _lines_advice(artifact, [v.on_stage(artifact).turn_lines or 0
                                           for v in views if v.angular])
    return tuple(advice) or _tried(artifact, views)


def one_pitch(artifact: Artifact) -> str:
    """Return a shift by one pitch in words; of a list of marks, by their distance."""
    return f"{artifact.grid_pitch_m * MM_PER_M:.2g} mm" if artifact.marks else "one pitch"


def quarter_turn(artifact: Artifact) -> str:
    """Return a quarter turn in words, with the shift that it needs to lie on the lattice."""
    beside = " and shifted by half a pitch along X and Y" if artifact.quarter_shift else ""
    return f"turned by 90 deg{beside}"


def _tried(artifact: Artifact, views: tuple[View, ...]) -> tuple[str, ...]:
    """Return the first single view, by trial, that cures the plan."""
    pitch, beside = artifact.grid_pitch_m, artifact.quarter_shift * artifact.grid_pitch_m
    if artifact.map_grid is not None:
        return (f"add views turned by 90 deg and shifted by about {one_pitch(artifact)}, or give "
                "the map fewer nodes",)
    for name, turn, shift in (("shifted by one pitch along Y", 0.0, (0.0, pitch)),
                              ("shifted by one pitch along X", 0.0, (pitch, 0.0)),
                              (quarter_turn(artifact), math.pi / 2, (beside, beside)),
                              ("that is neither turned nor shifted", 0.0, (0.0, 0.0))):
        more = View("", turn, shift, True, artifact.angular_count > 0 and (
            not turn or artifact.angular_count % 4 == 0))
        if identifies(artifact, (*views, more)):
            return (f"add a view {name}",)
    return ("add views turned by 90 deg and shifted by one pitch along X and along Y",)


def _lines_advice(artifact: Artifact, turns: list[float]) -> list[str]:
    """Return advice on the view of lines that is missing, if one is; turns in lines."""
    count = artifact.angular_count
    if artifact.harmonics:
        lacks = HarmonicSystem(tuple(turns), np.ones((len(turns), count)), artifact.harmonics)
        best = best_turn_deg(np.array(turns) * (2 * np.pi / count), artifact.harmonics)
        return [f"add an angular view turned by {best} deg"] if lacks.missed else []
    apart = [round(turn - turns[0]) for turn in turns]
    return [f"add an angular view turned by one line ({360 / count:g} deg)"] if math.gcd(
        count, *apart) > 1 else []


def best_turn_deg(turns_rad: np.ndarray, harmonics: int) -> int:
    """Return the turn, in whole degrees, of the further view that adds most to a Fourier map."""
    of_turns, number = np.exp(1j * np.outer(turns_rad, np.arange(1, harmonics + 1))), len(turns_rad)
    turns_deg = np.arange(1, 180)
    more = of_turns.sum(axis=0) + np.exp(
        1j * np.outer(np.radians(turns_deg), np.arange(1, harmonics + 1)))
    information = number + 1 - np.abs(more) ** 2 / (number + 1)  # information on each, in 2 / K
    return int(turns_deg[(1 / np.maximum(information, 1e-12)).sum(axis=1).argmin()])


def refusal(observability: Observability) -> str:
    """Return the line that refuses a deficient measurement and names the cure."""
    modes = f"{observability.deficiency} mode" + "s" * (observability.deficiency != 1)
    return (f"the marks that were read do not identify the stage ({modes} undetermined): "
            + "; ".join(observability.advice))


MATCH = 1e-9
"""Largest relative residual sum of squares of an unseen field."""


@dataclass(frozen=True, eq=False)
class UnseenMode:
    """A family of stage errors that the readings cannot separate from plate errors.

    Attributes
    ----------
    name : str
        Short name, such as ``non-orthogonality``.
    text : str
        The family in words.
    example : float array (2, nx, ny)
        One member, largest value 1, stage frame; empty for an angular family.
    """

    name: str
    text: str
    example: np.ndarray


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
    total = float((grid.weight * abs(residual) ** 2).sum())
    scale = float((grid.weight * abs(y) ** 2).sum())
    right = np.zeros(system.size)
    right[:3 * grid.n_views] = grid.right_side(y)[1]
    block = np.zeros((system.size, system.size))
    block[:len(grid.block), :len(grid.block)] = grid.block
    if system.angular.n_views:
        # the angular lines relate the rotations as far as they were read
        weight = system.grid_scale / system.angular_scale
        block[np.ix_(system.phi_at, system.phi_at)] += weight * system.angular.schur
        block = grid.tied(block)
    explained = right @ pseudo_inverse(*np.linalg.eigh(block), system.grid_scale) @ right
    return bool(total - explained <= MATCH * scale)


def unseen_modes(system: NormalEquations) -> Iterator[UnseenMode]:
    """Yield the unseen families of a set of readings, the named ones first."""
    grid, modes = system.grid, system.loose_modes
    if grid.n_views > 1:
        yield from _known_families(system)
    if len(modes):
        yield UnseenMode("undetermined fields", f"{len(modes)} fields whose standard uncertainty "
                         "exceeds ten times the noise of a reading", as_map(modes[0]))
    yield from _component_family(grid)
    missing = (grid.components.of_site < 0).reshape(grid.views.shape)
    if missing.any():
        at = np.argwhere(missing)[0] - np.array(grid.views.shape) // 2
        yield UnseenMode("sites never visited", f"{int(missing.sum())} sites that no mark reaches, "
                         f"the first is ({at[0]}, {at[1]})", as_map(missing.astype(complex)))
    if n := int((grid.components.of_mark < 0).sum()):
        yield UnseenMode("marks never read", f"{n} marks of the plate that no view reads",
                         np.zeros((0,)))
    if system.angular.n_views:
        yield from _angular_families(system.angular)


def _known_families(system: NormalEquations) -> Iterator[UnseenMode]:
    """Yield the unseen fields among the named ones."""
    z = system.grid.views.z_sites
    x, y = z.real, z.imag
    for name, text, field in (
            ("non-orthogonality", "non-orthogonality of the axes: Gx = O y, Gy = O x", y + 1j * x),
            ("scale difference", "scale difference of the axes: Gx = R x, Gy = -R y", x - 1j * y),
            ("bending along x", "steady turn from column to column: Gx = x y, Gy = -x^2/2",
             x * y - 0.5j * x**2),
            ("bending along y", "steady turn from row to row: Gx = y^2/2, Gy = -x y",
             0.5 * y**2 - 1j * x * y)):
        if is_unseen(system, field):
            yield UnseenMode(name, text, as_map(field))


def _component_family(grid: GridSystem) -> Iterator[UnseenMode]:
    """Yield the family of vectors left free by balanced components, unless one spans all."""
    parts = grid.components
    free = np.flatnonzero(parts.balanced)
    if len(free) < 2 and not (len(free) == 1 and len(parts.balanced) > 1):
        return
    label = np.where((parts.of_site >= 0) & np.isin(parts.of_site, free), parts.of_site, -1)
    label, phase = label.reshape(grid.views.shape), grid.free_turns[0]
    signs = np.where(label >= 0, phase.reshape(label.shape), 0)
    name, text = _shape_of(grid, label, n=len(free))
    # the example: one component against the rest
    yield UnseenMode(name, text, as_map(np.where(label == free[0], PHASES[signs], 0)))


def _shape_of(grid: GridSystem, label: np.ndarray, *, n: int) -> tuple[str, str]:
    """Name the pattern of the free components on the field."""
    shifts = {(pose.a, pose.b) for pose in grid.views.poses}
    turns = sorted({(pose.q - grid.views.poses[0].q) % 4 for pose in grid.views.poses})
    if len(grid.views.poses) == 1:
        return "every field", "everything: one view cannot separate the stage from the plate"
    for axis, line in ((0, "rows"), (1, "columns")):
        first = np.take(label, [label.shape[axis] // 2], axis=axis)
        if (label == first).all():
            return (f"{line[:-1]} offsets",
                    f"offsets of the {line} against each other, in x and in y"
                    + (f", opposite in opposite {line}" if len(turns) > 1 else ""))
    own = f"{2 * n - 2} numbers beside the datum"  # rotation and scale, or the translations
    if len(shifts) == 1:
        turn = "quarter" if any(t % 2 for t in turns) else "half"
        return ("rotation-symmetric fields", f"rotation-symmetric fields: every field that a "
                f"{turn} turn maps to itself ({own})")
    period = _period(label)
    if period:
        along = " and ".join(f"every {p} pitches along {a}"
                             for p, a in zip(period, "xy", strict=True) if p > 1)
        return "periodic fields", f"patterns that repeat {along} ({own})"
    return ("separate groups of sites", f"{n} groups of sites that no reading connects: "
            f"each may move independently; the smallest is {_smallest(grid, label)}")


def _period(label: np.ndarray) -> tuple[int, int] | None:
    """Return the smallest period of the components along x and y, None if there is none."""
    out = []
    for axis in (0, 1):
        size = label.shape[axis]
        moved = [p for p in range(1, size // 2 + 1)
                 if np.array_equal(np.take(label, range(p, size), axis=axis),
                                   np.take(label, range(size - p), axis=axis))]
        if not moved:
            return None
        out.append(moved[0])
    return (out[0], out[1]) if max(out) > 1 else None


def _smallest(grid: GridSystem, label: np.ndarray) -> str:
    numbers, sizes = np.unique(label[label >= 0], return_counts=True)
    at = np.argwhere(label == numbers[np.argmin(sizes)])
    text = ", ".join(f"({m}, {n})" for m, n in at[:4] - np.array(grid.views.shape) // 2)
    return text + (", ..." if len(at) > 4 else "")


def _angular_families(angular: AngularSystem) -> Iterator[UnseenMode]:
    """Yield the unseen modes of the angular map, in words."""
    if isinstance(angular, HarmonicSystem):
        if angular.missed:
            *most, last = (str(number) for number in angular.missed)
            numbers = f"s {', '.join(most)} and {last}" if most else f" {last}"
            why = ("no view turns the lines" if angular.n_views < 2 else
                   "every turn between views is a whole number of their periods, or nearly so")
            yield UnseenMode("angular harmonics", f"angular map: harmonic{numbers}, as {why}",
                             np.zeros((0,)))
        return
    parts = angular.components
    n = len(parts.balanced)
    if n > 1:
        yield UnseenMode("angular groups", _angular_text(parts, n), np.zeros((0,)))
    missing = int((parts.of_site < 0).sum())
    if missing:
        yield UnseenMode("lines never visited", f"{missing} angles of the stage that no line "
                         "reaches", np.zeros((0,)))


def _angular_text(parts: Components, n: int) -> str:
    lines = np.arange(len(parts.of_site))
    if np.array_equal(parts.of_site, parts.of_site[lines % n]):
        if n == len(lines):
            return "angular map: everything, as no view turns the lines"
        return f"angular map: patterns that repeat every {n} lines"
    return f"angular map: {n} groups of lines that no view connects"


def as_map(field: np.ndarray) -> np.ndarray:
    """Return a complex field (nx, ny) as (2, nx, ny), largest value 1."""
    both = np.stack([field.real, field.imag]).astype(float)
    return both / max(float(abs(both).max()), np.finfo(float).tiny)


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
    poses = [view.pose for view in views]
    steps = [(round(pose.turn_rad / (math.pi / 2), 9) % 4, complex(
        *(round(shift / artifact.grid_pitch_m, 6) for shift in pose.shift_m))) for pose in poses]
    turns = range(0, 4, 1 if artifact.shape[0] == artifact.shape[1] else 2)
    forms = list(product((False, True), turns, turns)) if artifact.marks is None else [
        (False, 0, 0)]
    return min(tuple(sorted(_moved(q, shift, *form) for q, shift in steps)) for form in forms)


def _moved(q: float, shift: complex, mirror: bool, stage: int,
           plate: int) -> tuple[float, float, float]:
    if mirror:
        q, shift = -q, shift.conjugate()
    shift = shift * complex(PHASES[stage])
    return (q + plate) % 4, shift.real + 0.0, shift.imag + 0.0

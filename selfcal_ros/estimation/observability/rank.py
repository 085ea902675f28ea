# SPDX-License-Identifier: Apache-2.0
"""Exact rank of a set of views, or of the marks that were read in them.

The rank does not depend on a tolerance for a large matrix. With misalignments known, it is a count
of graph components (`lattice.connectivity`); the misalignments add the rank of a matrix with
three rows per view, whose zeros and non-zeros are ten orders of magnitude apart (method eqs. 6.1,
6.2).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.normal.angular import HarmonicSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.systems import Memo, planned_system
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

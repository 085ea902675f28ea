# SPDX-License-Identifier: Apache-2.0
"""Pose of the plate in a view from where its named marks are seen, compared with the plan.

A turn and a shift lead from the places of the marks on the plate to those on the stage. If they are
not the planned ones, the plate has another pose, or the ids are those of other marks. If it takes a
mirror, the ids are mirrored, or the plate lies upside down. Wrong joints affect all views: a
view that is as planned shows that they are right.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.checks.placing import Misplaced, placing_error
from selfcal_ros.model.pose import StagePose

AT_LEAST = 5
"""Smallest number of named marks that show a pose."""
SPREAD = 0.5
"""Smallest standard deviation of their places along any direction, pitches."""
STEPS = 6
"""Steps to the pose by least absolute distances: single ids may be wrong."""
SAME_SIZE = 0.1
"""Largest deviation from 1 of the ratio of distances on stage and plate."""
OFF_CENTRE = 0.25
"""Distance from the centre of the field beyond which a site tells wrong joints, pitches."""
NEAR = 0.3
"""Distance, in pitches, within which a shift is taken to be a likely one."""
SURELY = 0.5
"""Largest ratio of the distances of the marks from their places, found over planned pose."""
MIRRORS = {
    0: "{n} reversed",
    90: "{m} and {n} exchanged",
    180: "{m} reversed",
    270: "{m} and {n} exchanged and both reversed",
}
"""Turn, deg, of the mirrored marks (m, -n) -> what the ids are."""

OTHER_SENSE = (
    "; or, if all shifts are as planned, the other of microscope and plate moves: correct "
    "measurement_sense (--sense), and find the turn of the camera again, 180° from here"
)
"""What explains reversed shifts as well, if no mark has an id."""


@dataclass(frozen=True, eq=False)
class NamedMarks:
    """Named marks of a view.

    Attributes
    ----------
    view, pose : str, StagePose
        Its name, and how the plan places the plate.
    marks : complex array (n,)
        Places on the plate, pitches.
    stage : complex array (n,)
        Places of the optical axis as indicated, in the sense of the measurement, pitches.
    cells, offsets : complex array (n,)
        Places in the image, and what the microscope measured from there, pitches.
    listed : bool
        Whether the plate is a list of marks.
    """

    view: str
    pose: StagePose
    marks: np.ndarray
    stage: np.ndarray
    cells: np.ndarray
    offsets: np.ndarray
    listed: bool = False

    @property
    def sites(self) -> np.ndarray:
        """Planned sites of the marks, complex (n,), pitches."""
        x, y = self.pose.site_of(self.marks.real, self.marks.imag)
        return x + 1j * y

    @property
    def spread(self) -> bool:
        """Whether the marks are enough to show a pose."""
        if len(self.marks) < AT_LEAST:
            return False
        places = np.stack([self.marks.real, self.marks.imag])
        return bool(np.linalg.eigvalsh(np.cov(places))[0] > SPREAD**2)

    def away(self, stage: np.ndarray) -> float:
        """Return the median distance of the stage from the planned sites off the centre."""
        sites = self.sites
        outer = np.abs(sites) > OFF_CENTRE
        return (
            float(np.median(np.abs(stage + self.cells - sites)[outer]))
            if outer.any()
            else 0.0
        )


@dataclass(frozen=True)
class SeenPose:
    """How a view's marks are seen: with the turn and shift found, or mirrored.

    `explained` is the part of the marks near whose places the stage then stands, `named` whether
    they have ids.
    """

    pose: Misplaced
    planned: bool
    mirrored: bool
    mirror: str = ""
    explained: float = 1.0
    named: bool = True

    def text(self, other_views: str) -> str:
        """Return what is wrong, and the remedy, in one line; `other_views`: what they show."""
        if self.mirrored:
            return (
                f"{self.mirror}, or the plate lies upside down; correct the ids, or place "
                f"the plate as planned and measure this view again{other_views}"
            )
        error = placing_error(self.pose)
        or_ids = " (or its ids are those of other marks)" if self.named else ""
        return f"{error.what}{or_ids}; {error.remedy}{other_views}"


def seen_poses(
    views: Mapping[int, NamedMarks], limit: float, max_rotation_rad: float
) -> dict[int, SeenPose]:
    """Return view_index -> how its marks are seen, of views that show it.

    Parameters
    ----------
    views : dict
        view_index -> named marks.
    limit : float
        Largest distance of the stage from the site of a mark, pitches.
    max_rotation_rad : float
        Largest rotation of a plate that lies as planned.
    """
    found_poses = (
        (index, _found_pose(view, limit, max_rotation_rad))
        for index, view in views.items()
    )
    return {
        index: seen_pose for index, seen_pose in found_poses if seen_pose is not None
    }


def texts(poses: Mapping[int, SeenPose]) -> dict[int, str]:
    """Return view_index -> what is wrong with views that are not seen as planned."""
    wrong = {
        index: seen_pose for index, seen_pose in poses.items() if not seen_pose.planned
    }
    other_views = ""
    if _fit_the_other_sense(poses.values()):
        other_views = OTHER_SENSE
    elif len(wrong) < len(poses):
        other_views = (
            "; other views are as planned: leave the joints and the sense as they are"
        )
    exchanged = dict(_exchanged(wrong))
    return {
        index: f"{exchanged[index]}{other_views}"
        if index in exchanged
        else seen_pose.text(other_views)
        for index, seen_pose in wrong.items()
    }


def _fit_the_other_sense(poses: Iterable[SeenPose]) -> bool:
    """Return whether the views without ids also lie as planned for the other sense.

    It turns all places by 180°, as another turn of the camera does: shifts show it alone.
    """
    return all(
        not seen_pose.named
        and seen_pose.pose.found_deg == seen_pose.pose.planned_deg
        and bool(
            np.hypot(*np.add(seen_pose.pose.found_shift, seen_pose.pose.planned_shift))
            < NEAR
        )
        for seen_pose in poses
    )


def mirrored_alike(poses: Iterable[SeenPose]) -> str:
    """Return what the ids are, if those of all views are mirrored alike, and remedy; else empty."""
    mirrors = {seen_pose.mirror if seen_pose.mirrored else "" for seen_pose in poses}
    mirror = mirrors.pop() if len(mirrors) == 1 else ""
    return f"{mirror}, or the plate lies upside down; correct the ids" if mirror else ""


def _exchanged(wrong: Mapping[int, SeenPose]) -> Iterator[tuple[int, str]]:
    """Yield the views in which the plate lies as planned for another one, and this one."""
    for index, seen_pose in wrong.items():
        for other_index, other_pose in wrong.items():
            if (
                other_index != index
                and not seen_pose.mirrored
                and _lies_as(seen_pose, other_pose)
                and _lies_as(other_pose, seen_pose)
            ):
                yield (
                    index,
                    (
                        f"the plate lies as planned for view '{other_pose.pose.view}', and there "
                        "as planned for this one: the views are exchanged; measure them in "
                        "the order of the plan, or exchange them in the plan"
                    ),
                )


def _lies_as(seen_pose: SeenPose, other_pose: SeenPose) -> bool:
    a, b = seen_pose.pose, other_pose.pose
    return (
        not other_pose.mirrored
        and a.found_deg == b.planned_deg
        and bool(np.hypot(*np.subtract(a.found_shift, b.planned_shift)) < NEAR)
    )


def _found_pose(
    view: NamedMarks, limit: float, max_rotation_rad: float
) -> SeenPose | None:
    """Return how the marks of a view are seen; None if they do not show it."""
    if not view.spread:
        return None
    pose = view.pose
    axis = view.stage + view.cells
    planned_distance = float(np.quantile(np.abs(axis - view.sites), 0.9))
    as_planned = Misplaced.of(view.view, pose, pose)
    fits = [
        (*_fitted(view.marks, at, mirrored), mirrored)
        for mirrored in (False, True)
        for at in (axis, axis + view.offsets)
    ]
    turn, shift, fitted_distance, mirrored = min(fits, key=lambda fit: fit[2])
    if planned_distance <= limit and fitted_distance > SURELY * planned_distance:
        return SeenPose(as_planned, planned=True, mirrored=False)
    if fitted_distance > limit:
        return None
    if mirrored:
        back = np.degrees(np.angle(turn)) - pose.turn_deg
        return SeenPose(
            as_planned,
            planned=False,
            mirrored=True,
            mirror=_mirror(back, listed=view.listed),
        )
    misplaced = replace(
        as_planned,
        found_deg=_turn(turn, pose, max_rotation_rad),
        found_shift=_shift(shift, pose),
    )
    near = np.abs(axis - (turn * view.marks + shift)) <= limit
    return SeenPose(
        misplaced,
        planned=misplaced == as_planned,
        mirrored=False,
        explained=float(near.mean()),
    )


def _fitted(
    marks: np.ndarray, at: np.ndarray, mirrored: bool
) -> tuple[complex, complex, float]:
    """Return the turn, the shift and what nine of ten distances are below, pitches."""
    z = marks.conj() if mirrored else marks
    free = np.stack([np.ones(len(z)), z], axis=1)
    weight = np.ones((len(z), 1))
    motion = np.zeros(2, dtype=complex)
    for _ in range(STEPS):
        motion = np.linalg.lstsq(weight * free, weight[:, 0] * at, rcond=None)[0]
        weight = np.maximum(np.abs(at - free @ motion), NEAR / 10)[:, None] ** -0.5
    size = abs(motion[1])
    if abs(size - 1) > SAME_SIZE:
        return 1, 0, float("inf")
    turn = motion[1] / size
    shifts = at - turn * z
    shift = complex(np.median(shifts.real), np.median(shifts.imag))
    return turn, shift, float(np.quantile(np.abs(shifts - shift), 0.9))


def _turn(turn: complex, pose: StagePose, max_rotation_rad: float) -> float:
    """Return a turn, 0 to 360°: a likely one, if it is within the rotation of a plate."""
    deg = float(np.degrees(np.angle(turn)))
    likely = (
        pose.turn_deg,
        -pose.turn_deg,
        0.0,
        *(pose.turn_deg + 90.0 * q for q in (1, 2, 3)),
    )
    away = [abs((deg - candidate_deg + 180) % 360 - 180) for candidate_deg in likely]
    best = int(np.argmin(away))
    turn_deg = likely[best] if away[best] < np.degrees(max_rotation_rad) else round(deg)
    return float(turn_deg % 360)


def _shift(shift: complex, pose: StagePose) -> tuple[float, float]:
    """Return a shift, pitches: a likely one, if it is near."""
    a, b = pose.shift
    likely = [
        (a, b),
        (-a, -b),
        (0, 0),
        (b, a),
        (-b, -a),
        (round(shift.real), round(shift.imag)),
    ]
    away = [abs(shift - complex(*candidate)) for candidate in likely]
    best = int(np.argmin(away))
    return (
        likely[best]
        if away[best] < NEAR
        else (round(shift.real, 1), round(shift.imag, 1))
    )


def _mirror(turn_deg: float, *, listed: bool) -> str:
    """Return what the ids of mirrored marks are."""
    quarter = round(turn_deg / 90)
    if abs(turn_deg - 90 * quarter) > 45 * NEAR:
        return "the ids are mirrored"
    m, n = ("x", "y") if listed else ("m", "n")
    subject = "the list has" if listed else "the ids have"
    return f"{subject} {MIRRORS[90 * quarter % 360].format(m=m, n=n)}"

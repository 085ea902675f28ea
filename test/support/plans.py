# SPDX-License-Identifier: Apache-2.0
"""Plans written as in the tables: '0, 90, tx', on any plate."""

import math
from collections.abc import Sequence

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.plan_form import plan_from_dict
from selfcal_ros.model.view import Plan, View

POSES = {
    "0": (0, 0, 0),
    "90": (1, 0, 0),
    "180": (2, 0, 0),
    "270": (3, 0, 0),
    "tx": (0, 1, 0),
    "+tx": (0, 1, 0),
    "-tx": (0, -1, 0),
    "ty": (0, 0, 1),
    "-ty": (0, 0, -1),
    "tx2": (0, 2, 0),
    "ty2": (0, 0, 2),
    "90tx": (1, 1, 0),
}

QIAO_TABLES = [
    # views, rank, unknowns (Qiao, tables 1-4)
    ("0", lambda n: 2 * n**2 + 7, 3),
    ("90", lambda n: 2 * n**2 + 7, 3),
    ("180", lambda n: 2 * n**2 + 7, 3),
    ("tx", lambda n: 2 * n**2 - 2 * n + 7, 3),
    ("0, 90", lambda n: (7 * n**2 + 17) // 2, 6),
    ("0, 180", lambda n: 3 * n**2 + 9, 6),
    ("0, tx", lambda n: 4 * n**2 - 2 * n + 7, 6),
    ("0, 90, 180", lambda n: (7 * n**2 + 23) // 2, 9),
    ("0, 90, tx", lambda n: 4 * n**2 + 9, 9),
    ("0, 180, tx", lambda n: 4 * n**2 - n + 10, 9),
    ("0, +tx, -tx", lambda n: 4 * n**2 - 2 * n + 10, 9),
    ("0, tx, ty", lambda n: 4 * n**2 + 7, 9),
    ("0, 90, 180, tx", lambda n: 4 * n**2 + 12, 12),
    ("0, 90, +tx, -tx", lambda n: 4 * n**2 + 12, 12),
    ("0, 90, tx, ty", lambda n: 4 * n**2 + 12, 12),
    ("0, 180, +tx, -tx", lambda n: 4 * n**2 - n + 13, 12),
    ("0, 180, tx, ty", lambda n: 4 * n**2 + 10, 12),
    ("0, +tx, -tx, ty", lambda n: 4 * n**2 + 10, 12),
]


def plan_of(
    text: str,
    size: int = 5,
    *,
    count: int = 0,
    size_y: int = 0,
    line: bool = False,
    repeats: int = 1,
) -> Plan:
    """Return the plan of views such as '0, 90, tx'; `line` adds the turn by one line."""
    artifact = Artifact(size, 0.01, count, size_y)
    names = [name.strip() for name in text.split(",")]
    views = [
        View(name, q * math.pi / 2, (a * 0.01, b * 0.01), True, count > 0, repeats)
        for name, (q, a, b) in ((name, POSES[name]) for name in names)
    ]
    if line:
        views.append(
            View("line", 2 * math.pi / count, (0.0, 0.0), False, True, repeats)
        )
    return Plan(text, artifact, tuple(views))


def image_plan(
    size: int = 7,
    *,
    turns: tuple[float, ...] = (0, 90),
    count: int = 0,
    repeats: int = 1,
    marks: int = 3,
) -> Plan:
    """Return a plan of turned views of a plate whose images show `marks` x `marks` marks.

    Lines are read in all views, and turned by one line.
    """
    lines = (
        [
            {
                "name": "line",
                "rotation_deg": 360 / count,
                "grid": False,
                "repeats": repeats,
            }
        ]
        if count
        else []
    )
    return plan_from_dict(
        {
            "plan_id": "images",
            "artifact": {
                "grid_size": size,
                "grid_pitch": 0.001,
                "angular_count": count,
            },
            "image": {"nx": marks, "ny": marks},
            "views": [
                {"name": f"{turn:g}", "rotation_deg": turn, "repeats": repeats}
                for turn in turns
            ]
            + lines,
        },
        "image plan",
    )


def harmonic_plan(
    count: int = 24,
    harmonics: int = 8,
    turns_deg: Sequence[float] = (37, 101),
    size: int = 5,
) -> Plan:
    """Return {0, 90, tx} of marks, with lines at 0 and in views of their own at other turns."""
    plate, quarter = Artifact(size, 0.01, count, harmonics=harmonics), math.pi / 2
    return Plan(
        "rotary",
        plate,
        (
            View("first"),
            View("quarter", quarter, angular=False),
            View("shift", 0.0, (0.01, 0.0), angular=False),
            *(View(f"{turn}deg", math.radians(turn), grid=False) for turn in turns_deg),
        ),
    )


def placed_plan(
    size: int = 7, *, size_y: int = 0, count: int = 0, repeats: int = 1
) -> Plan:
    """Return a plan of the views 0, 90, 37 deg and (1.3, -0.7) pitches, half a pitch.

    Lines are read in all views but the one at 37 deg, and turned by one line.
    """
    lines = (
        [
            {
                "name": "line",
                "rotation_deg": 360 / count,
                "grid": False,
                "repeats": repeats,
            }
        ]
        if count
        else []
    )
    return plan_from_dict(
        {
            "plan_id": "placed",
            "artifact": {
                "grid_size": size,
                "grid_pitch": 0.01,
                "angular_count": count,
                "grid_size_y": size_y,
            },
            "views": [
                {
                    "name": name,
                    "rotation_deg": turn,
                    "translation_pitch": shift,
                    "repeats": repeats,
                }
                for name, turn, shift in (
                    ("0", 0, [0, 0]),
                    ("90", 90, [0, 0]),
                    ("37", 37, [1.3, -0.7]),
                    ("half", 0, [0.5, 0]),
                )
            ]
            + lines,
        },
        "plan",
    )

# SPDX-License-Identifier: Apache-2.0
"""The parameters of mark_detector, which are the options of ``selfcal detect`` as well."""

import re
from dataclasses import dataclass
from typing import ClassVar

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.settings.parameter import ManagedSettings, declared, place_of

MARKS = ("disc", "ring", "cross", "corner")
OPTIONS = {
    name: name
    for name in (
        "pixel_size",
        "mark",
        "mark_size",
        "mark_width",
        "polarity",
        "turn",
        "mirror",
    )
}
"""Options of commands that look for marks -> names of parameters."""


ANY_NUMBER = 1_000_000
"""`max_marks` of images that somebody waits for: no limit."""


@dataclass(frozen=True)
class DetectorSettings(ManagedSettings):
    """How mark_detector finds marks in images."""

    NODE: ClassVar[str] = "mark_detector"
    frame_id: str = declared("stage", "frame of published messages (REP-103)")
    pixel_size: float = declared(
        0.0, "side of a pixel on the plate; must be set", "m", 0.0, 1.0
    )
    mark: str = declared("disc", "kind of mark", choices=MARKS)
    mark_size: float = declared(
        0.0,
        "diameter of a disc or ring, length of the bars of a cross, side of the squares that "
        "meet in a corner; must be set",
        "m",
        0.0,
        1000.0,
    )
    mark_width: float = declared(
        0.0,
        "width of the line of a ring or cross; 0 = a fifth of mark_size",
        "m",
        0.0,
        1000.0,
    )
    polarity: str = declared(
        "dark",
        "marks against the background; corners are both",
        choices=("dark", "bright"),
    )
    turn: float = declared(
        0.0,
        "angle by which the camera's image is turned to lie along the stage axes, "
        "counter-clockwise",
        "deg",
        -360.0,
        360.0,
    )
    mirror: bool = declared(
        False, "the image is mirrored: columns run along -x before the turn"
    )
    aruco: str = declared(
        "",
        "marks along x and y of a plate with ArUco markers (selfcal plate --aruco), as in "
        "11x9: marks beside a marker get its ids; needs OpenCV; empty = none",
    )
    transport: str = declared(
        "raw",
        "topic of the images: stage/image or stage/image/compressed",
        choices=("raw", "compressed"),
    )
    full_scale: int = declared(
        0,
        "value of a saturated pixel; 0 = the largest of the encoding, or of a camera with 9 to 15 "
        "bits in mono16 where an image ends at it (4095)",
        "",
        0,
        65535,
    )
    max_blur: float = declared(
        0.15,
        "blur of a mark, over its size or over 10 px, whichever is larger, above which it is "
        "rejected as defocused",
        "",
        0.0,
        1.0,
    )
    size_tolerance: float = declared(
        0.2,
        "relative deviation from mark_size above which a mark is rejected",
        "",
        0.0,
        1.0,
    )
    max_sigma_px: float = declared(
        0.3,
        "standard uncertainty of a centre above which a mark is rejected as weak",
        "px",
        0.0,
        100.0,
    )
    max_marks: int = declared(
        1000,
        "possible marks of an image above which it is refused, as each takes a millisecond; "
        "files are not limited",
        "",
        1,
        ANY_NUMBER,
    )
    max_waiting: int = declared(
        32, "images that may wait; more are discarded and counted", "", 1, 1000
    )

    def require_plate(self, artifact: Artifact, where: str) -> None:
        """Refuse the markers of another plate, whose ids would be those of other marks.

        Parameters
        ----------
        artifact : Artifact
            Plate of the plan.
        where : str
            Place of the parameters, for errors.

        Raises
        ------
        InputError
            If `aruco` is set and this plate is not the one it describes.
        """
        if not self.aruco:
            return
        if artifact.marks is not None:
            raise InputError(
                place_of(where, "aruco"),
                "the plate of the plan is a list of marks, and markers name those of a lattice",
                "leave aruco out",
            )
        if coded_shape(self.aruco, where) != artifact.shape:
            nx, ny = artifact.shape
            raise InputError(
                place_of(where, "aruco"),
                f"'{self.aruco}', but the plate of the plan has {nx} x {ny} marks",
                f"write {nx}x{ny}, or correct the plan",
            )


def coded_shape(text: str, where: str) -> tuple[int, int]:
    """Return the marks along x and y of a plate with markers; InputError if they are not told."""
    match = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if not match:
        raise InputError(
            place_of(where, "aruco"),
            f"'{text}' is not the marks along x and y",
            "write for example 11x9",
        )
    return int(match[1]), int(match[2])

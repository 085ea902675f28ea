# SPDX-License-Identifier: Apache-2.0
"""The formats in a table: what each can say, its files with their comments, and a trial of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from selfcal_ros.applications.controllers.axes import (
    read_linuxcnc,
    read_siemens,
    write_linuxcnc,
    write_siemens,
)
from selfcal_ros.applications.controllers.grid import Source, Wiring
from selfcal_ros.applications.controllers.planes import (
    Texts,
    read_beckhoff,
    read_kmotion,
    read_pmac,
    write_beckhoff,
    write_kmotion,
    write_pmac,
)
from selfcal_ros.compensation.export import comment_text, provenance
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import (
    Correction,
    Residual,
    bends_between,
    combined,
    plane_residuals,
)
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import spelled_out
from selfcal_ros.units import UM_PER_M

HELD = 0.01
"""Part of the errors at the nodes below which a format holds the map."""
IMPLIED = (
    "the sense is not documented: the value is taken to be added; if --negate of selfcal "
    "export is needed, the machine gets twice its error"
)
NEGATED = (
    "the sense is not documented: the value is taken to be subtracted (--negate), and is "
    "- (indicated - true); a controller that adds it gets twice its error"
)
HOW = "this table: "
"""Begins the comment that says of a file what the frame of the machine does not."""
WRITTEN_SO = (
    "give the options with which it was written; if the controller uses it otherwise, delete this "
    "comment first"
)
"""How an active table is used whose comment is not that of the options."""


@dataclass(frozen=True)
class Format:
    """What is particular to a controller.

    Attributes
    ----------
    what : str
        The controller and its table.
    write, read : callable
        Lines of its files from a map; and what the controller adds once it has read them.
    comment : str
        Begins a comment.
    unit : str
        Unit of its lengths, if not chosen.
    comments_last : bool
        Whether comments are possible only after the table.
    sign_is_implied : bool
        Whether no document says that the value is added.
    parts : tuple of str
        What is added to the name of each file.
    notes : tuple of str
        What the format cannot say, and what the machine needs; {unit} is that of the positions.
    steps : tuple of str
        How the files are put into use, step by step, and how they are seen to act; {files}, {x}
        and {y} are their names and axes.
    """

    what: str
    write: Callable[[ErrorMap, Wiring], Texts]
    read: Callable[[Sequence[Source], Wiring], Correction]
    comment: str
    unit: str = "mm"
    comments_last: bool = False
    sign_is_implied: bool = False
    parts: tuple[str, ...] = ("",)
    notes: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()


FORMATS = {
    "kmotion": Format(
        what="Dynomotion KMotion: Geo Table",
        write=write_kmotion,
        read=read_kmotion,
        comment="# ",
        unit="in",
        comments_last=True,
        notes=(
            "unit of the positions: {unit}; it has to be that of KMotion's coordinates (in its "
            "source: in)",
        ),
        steps=(
            "KMotionCNC, Tool Setup, Trajectory Planner: enter {files} as Geometric Correction",
            "set Collinear Tolerance there: arcs are split into lines that differ by at most it",
            "see it act: the position of the axis channels, not the display of X and Y, shows the "
            "corrected position",
        ),
    ),
    "pmac": Format(
        "Delta Tau Turbo PMAC: 2D compensation",
        write_pmac,
        read_pmac,
        "; ",
        notes=(
            "motors are counted from their zero; beyond the field the tables roll over",
        ),
        steps=(
            "delete the buffers that stand before it (DELETE LOOKAHEAD, DELETE GATHER, DELETE "
            "ROTARY; old tables: DELETE COMP from the lower motor to the higher)",
            "send {files} to the controller, then I51=1 and SAVE",
            "see it act: home, then read Mxx69 of motors {x} and {y} (the correction, in 1/(32 "
            "Ixx08) count)",
        ),
    ),
    "beckhoff": Format(
        "Beckhoff TF5200: plane compensation",
        write_beckhoff,
        read_beckhoff,
        "# ",
        sign_is_implied=True,
        parts=("x", "y"),
        notes=(
            "activate by lr_param.crosscomp2 1; lengths in 0.1 um",
            "decimals are read from V3.1.3132 / V4.29 on; for older ones export with --integers",
        ),
        steps=(
            "add the keys of {files} to the compensation lists of axes {x} and {y}, and set "
            "lr_param.crosscomp2 1 in the lists of both axes",
            "load the lists, restart, home",
            "see it act: no document was found that names a display of the value; measure",
        ),
    ),
    "linuxcnc": Format(
        "LinuxCNC: COMP_FILE of each joint, COMP_FILE_TYPE 0",
        write_linuxcnc,
        read_linuxcnc,
        "# ",
        comments_last=True,
        parts=("x", "y"),
        notes=(
            "one axis at a time: straightness and squareness remain",
            "a joint with a COMP_FILE ignores BACKLASH",
            "the correction at the controller's zero is subtracted",
        ),
        steps=(
            "put {files} beside the INI file; under [JOINT_{x0}] write COMP_FILE = {file_x} and "
            "COMP_FILE_TYPE = 0, under [JOINT_{y0}] COMP_FILE = {file_y} and COMP_FILE_TYPE = 0 "
            "(type 1 would move the axes by their whole position)",
            "restart LinuxCNC; a missing file ends the start without a word, and a first line "
            "that is blank or a comment makes the table empty",
            "see it act: halcmd getp joint.{x0}.backlash-corr and joint.{x0}.backlash-filt (y: "
            "joint.{y0}) show the correction, also before homing",
        ),
    ),
    "siemens": Format(
        "Siemens SINUMERIK: CEC",
        write_siemens,
        read_siemens,
        "; ",
        sign_is_implied=True,
        notes=(
            "a sum of functions of x and of y: what depends on both remains",
            "set MD18342 $MN_MM_CEC_MAX_POINTS, MD32710 $MA_CEC_ENABLE, SD41300 "
            "$SN_CEC_TABLE_ENABLE",
        ),
        steps=(
            "save the NC data, then set MD18342 $MN_MM_CEC_MAX_POINTS[0] to [3] to at least the "
            "number of values (this clears the memory of the NC)",
            "run {files} as a part program with SD41300 $SN_CEC_TABLE_ENABLE[0] to [3] = 0",
            "set MD32710 $MA_CEC_ENABLE of axes AX{x} and AX{y} and SD41300[0] to [3] to 1; home",
            "see it act: Diagnosis, Service axes, shows the compensation of sag and temperature",
        ),
    ),
}


@dataclass(frozen=True, eq=False)
class Exported:
    """Files of a controller by name, and the residuals before and after they are loaded.

    `bent_m` is how far the table that they replace bends between the nodes of the map.
    `checklist` has the steps that put the files into use; `remains` states the residual at the
    nodes if the format cannot hold the map, else it is empty.
    """

    files: dict[str, str]
    residuals: list[Residual]
    bent_m: float = 0.0
    checklist: tuple[str, ...] = ()
    remains: str = ""


def export(
    name: str,
    result: CalibrationResult,
    wiring: Wiring,
    output: str,
    *,
    active: Correction | None = None,
    filled: int = 0,
    command: str = "",
) -> Exported:
    """Return the files of a controller, tried on a simulated one.

    Parameters
    ----------
    name : str
        A key of `FORMATS`.
    result : CalibrationResult
        The calibration; its map without gaps.
    wiring : Wiring
        The controller's axes.
    output : str
        Name of the file; a part is added before its ending.
    active : Correction, optional
        The table that was loaded during the calibration: the new one replaces it.
    filled : int
        Number of sites of the map that were filled.
    command : str
        Command line, for the comments.

    Raises
    ------
    InputError
        If an option does not fit the format, or the map has unknown sites.
    """
    form = FORMATS[name]
    frame = wiring.frame
    emap = result.error_map
    if wiring.negate and not form.sign_is_implied:
        raise InputError("--negate", f"the sense of {name} is known", "leave it out")
    if wiring.integers and name != "beckhoff":
        raise InputError("--integers", f"{name} needs none", "leave it out")
    if wiring.counts is not None and name != "pmac":
        raise InputError(
            "--counts-per-unit", f"{name} is not in counts", "leave it out"
        )
    table = emap if active is None else combined(emap, frame, active)
    bent = 0.0 if active is None else bends_between(emap, frame, active)
    texts = form.write(table, wiring)
    names = {part: _name(output, part) for part in texts}
    correct = form.read(
        [Source("\n".join(lines) + "\n", names[part]) for part, lines in texts.items()],
        wiring,
    )
    residuals = plane_residuals(emap, frame, correct, active)
    comments = [
        form.what,
        *provenance(result, frame, filled=filled, command=command),
        *(note.format(unit=frame.unit) for note in form.notes),
        *([NEGATED if wiring.negate else IMPLIED] if form.sign_is_implied else []),
        _remaining_text(residuals[0]),
    ]
    if active is not None:
        comments.append(
            "replaces the table that was loaded during the calibration; what that "
            f"bends between the nodes of the map, up to {UM_PER_M * bent:.3g} µm, is lost"
        )
    files = {}
    for part, lines in texts.items():
        head = [
            form.comment + spelled_out(_plain(line))
            for line in [*comments, *_how(form, wiring, part)]
        ]
        files[names[part]] = (
            "\n".join([*lines, "", *head] if form.comments_last else [*head, *lines])
            + "\n"
        )
    remains = (
        ""
        if residuals[0].rms("after") < HELD * residuals[0].rms("before")
        else (_remaining_text(residuals[0]))
    )
    return Exported(
        files,
        residuals,
        bent,
        checklist(form, wiring, list(files), correct, table),
        remains,
    )


def _how(form: Format, wiring: Wiring, part: str) -> list[str]:
    """Return the comment on which file it is, on the counts and on the sense; or none."""
    words = [f"the file of {part}"] if part else []
    if wiring.counts is not None:
        words.append("counts per unit {:.15g} and {:.15g}".format(*wiring.counts))
    if form.sign_is_implied:
        words.append("subtracted" if wiring.negate else "added")
    return [HOW + ", ".join(words)] if words else []


def comments_of(text: str) -> list[str]:
    """Return the lines of a table without what begins a comment."""
    return [line.lstrip("#; ").rstrip() for line in text.splitlines()]


def _plain(text: str) -> str:
    """Return text for a comment: on its line, and nothing that begins or ends a comment of its own.

    Beckhoff's ``/* */`` comments go on over lines.
    """
    return comment_text(text).replace("*/", "* /").replace("/*", "/ *")


def checklist(
    form: Format,
    wiring: Wiring,
    files: Sequence[str],
    correct: Correction,
    table: ErrorMap,
) -> tuple[str, ...]:
    """Return the steps that put files into use; the last names the place to look at.

    That is the node at which the controller corrects by most, relative to its zero.
    """
    frame = wiring.frame
    names = [Path(file).name for file in files]
    steps = [
        step.format(
            files=" and ".join(names),
            file_x=names[0],
            file_y=names[-1],
            x=frame.x_axis,
            y=frame.y_axis,
            x0=frame.x_axis - 1,
            y0=frame.y_axis - 1,
        )
        for step in form.steps
    ]
    return (*steps, place_to_look(frame, correct, table))


def place_to_look(frame: MachineFrame, correct: Correction, table: ErrorMap) -> str:
    """Return where the controller corrects by most relative to its zero, and by how much."""
    valid = table.valid
    px, py = frame.to_machine(table.artifact.x_m[valid], table.artifact.y_m[valid])
    at_zero = [float(np.ravel(c)[0]) for c in correct(np.zeros(1), np.zeros(1))]
    cx, cy = (
        frame.unit_m * (np.asarray(c) - zero)
        for c, zero in zip(correct(px, py), at_zero, strict=True)
    )
    most = int(np.argmax(np.hypot(cx, cy)))
    return (
        f"the correction is largest at x = {px[most]:.6g} {frame.unit}, y = {py[most]:.6g} "
        f"{frame.unit}: relative to zero the axes go {UM_PER_M * cx[most]:+.4g} µm and "
        f"{UM_PER_M * cy[most]:+.4g} µm further there; measure it: the error must shrink, not "
        "double"
    )


def _remaining_text(sites: Residual) -> str:
    """Return what remains at the nodes, in words."""
    rms, largest = (UM_PER_M * size("after") for size in (sites.rms, sites.largest))
    return (
        f"left at the nodes on a simulated controller: {rms:.3g} µm rms, largest "
        f"{largest:.3g}, of {UM_PER_M * sites.rms('before'):.3g} µm rms"
    )


def _name(output: str, part: str) -> str:
    path = Path(output)
    return str(path.with_name(f"{path.stem}_{part}{path.suffix}")) if part else output


def loaded(name: str, sources: Sequence[Source], wiring: Wiring) -> Correction:
    """Return what a controller adds with these files loaded.

    Raises
    ------
    InputError
        If a file breaks a rule of the format.
    """
    parts = FORMATS[name].parts
    if len(sources) != len(parts):
        raise InputError(
            "--onto",
            f"{len(sources)} files",
            f"{name} has {len(parts)}: " + (", ".join(parts) or "the table"),
        )
    return FORMATS[name].read(sources, wiring)


def require_written_so(name: str, sources: Sequence[Source], wiring: Wiring) -> None:
    """Raise InputError if a file says that it is another one, of other counts or sense."""
    form = FORMATS[name]
    for part, source in zip(form.parts, sources, strict=False):
        for own in _how(form, wiring, part):
            for line in comments_of(source.text):
                if line.startswith(HOW) and line != own:
                    exchanged = part and not line.startswith(f"{HOW}the file of {part}")
                    raise InputError(
                        source.where,
                        f"it says '{line}', and is taken for '{own}'",
                        "name the file of x first" if exchanged else WRITTEN_SO,
                    )

# SPDX-License-Identifier: Apache-2.0
"""The formats in a table: what each can say, its files with their comments, and a trial of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from selfcal_ros.compensation.export import provenance
from selfcal_ros.compensation.residual import (
    Correction,
    Residual,
    bends_between,
    combined,
    plane_residuals,
)
from selfcal_ros.controllers.axes import (
    read_linuxcnc,
    read_siemens,
    write_linuxcnc,
    write_siemens,
)
from selfcal_ros.controllers.grid import Source, Wiring
from selfcal_ros.controllers.planes import (
    Texts,
    read_beckhoff,
    read_kmotion,
    read_pmac,
    write_beckhoff,
    write_kmotion,
    write_pmac,
)
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.units import UM_PER_M

IMPLIED = ("the sense is not documented: the value is taken to be added; if --negate of selfcal "
           "export is needed, the machine gets twice its error",)


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
        What the format cannot say, and what the machine needs.
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


FORMATS = {
    "kmotion": Format(
        "Dynomotion KMotion: Geo Table", write_kmotion, read_kmotion, "# ", "in", True, notes=(
            "positions in the unit of KMotion's coordinates, which is the inch",)),
    "pmac": Format(
        "Delta Tau Turbo PMAC: 2D compensation", write_pmac, read_pmac, "; ", notes=(
            "motors are counted from their zero; beyond the field the tables roll over",)),
    "beckhoff": Format(
        "Beckhoff TF5200: plane compensation", write_beckhoff, read_beckhoff, "# ",
        sign_is_implied=True, parts=("x", "y"), notes=(
            "activate by lr_param.crosscomp2 1; lengths in 0.1 um",
            "decimals are read from V3.1.3132 / V4.29 on; for older ones export with --integers")),
    "linuxcnc": Format(
        "LinuxCNC: COMP_FILE of each joint, COMP_FILE_TYPE 0", write_linuxcnc, read_linuxcnc, "# ",
        comments_last=True, parts=("x", "y"), notes=(
            "one axis at a time: straightness and squareness remain",
            "a joint with a COMP_FILE ignores BACKLASH")),
    "siemens": Format(
        "Siemens SINUMERIK: CEC", write_siemens, read_siemens, "; ", sign_is_implied=True, notes=(
            "a sum of functions of x and of y: what depends on both remains",
            "set MD18342 $MN_MM_CEC_MAX_POINTS, MD32710 $MA_CEC_ENABLE, SD41300 "
            "$SN_CEC_TABLE_ENABLE"))}


@dataclass(frozen=True, eq=False)
class Exported:
    """Files of a controller by name, and the residuals before and after they are loaded.

    `bent_m` is how far the table that they replace bends between the nodes of the map.
    """

    files: dict[str, str]
    residuals: list[Residual]
    bent_m: float = 0.0


def export(name: str, result: CalibrationResult, wiring: Wiring, output: str, *,
           active: Correction | None = None, filled: int = 0, command: str = "") -> Exported:
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
    form, frame, emap = FORMATS[name], wiring.frame, result.error_map
    if wiring.negate and not form.sign_is_implied:
        raise InputError("--negate", f"the sense of {name} is known", "leave it out")
    if wiring.integers and name != "beckhoff":
        raise InputError("--integers", f"{name} needs none", "leave it out")
    table = emap if active is None else combined(emap, frame, active)
    bent = 0.0 if active is None else bends_between(emap, frame, active)
    texts = form.write(table, wiring)
    names = {part: _name(output, part) for part in texts}
    correct = form.read([Source("\n".join(lines) + "\n", names[part])
                         for part, lines in texts.items()], wiring)
    residuals = plane_residuals(emap, frame, correct, active)
    comments = [form.what, *provenance(result, frame, filled=filled, command=command), *form.notes,
                *(IMPLIED if form.sign_is_implied else ()), _left(residuals[0])]
    if active is not None:
        comments.append("replaces the table that was loaded during the calibration; what that "
                        f"bends between the nodes of the map, up to {UM_PER_M * bent:.3g} um, is "
                        "lost")
    head = [form.comment + "".join(c if c.isprintable() else " " for c in line)
            for line in comments]
    files = {names[part]: "\n".join([*lines, "", *head] if form.comments_last
                                    else [*head, *lines]) + "\n" for part, lines in texts.items()}
    return Exported(files, residuals, bent)


def _left(sites: Residual) -> str:
    """Return what remains at the nodes, in words."""
    rms, largest = (UM_PER_M * size("after") for size in (sites.rms, sites.largest))
    return (f"left at the nodes on a simulated controller: {rms:.3g} um rms, largest "
            f"{largest:.3g}, of {UM_PER_M * sites.rms('before'):.3g} um rms")


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
        raise InputError("--onto", f"{len(sources)} files", f"{name} has {len(parts)}: "
                         + (", ".join(parts) or "the table"))
    return FORMATS[name].read(sources, wiring)

# SPDX-License-Identifier: Apache-2.0
"""The verbs of ``selfcal``: group, what they do, an example of each.

``setup.py`` reads this module, too, and registers them as entry points of the group
``selfcal.verbs``. The entry points of other packages are looked for only when a word is not in
`VERBS`, and by ``selfcal --help``: looking through all installed packages takes longer than all
else that a verb needs to start.
"""

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint  # slow, and for types only

ENTRY_POINTS = "selfcal.verbs"
"""Group of entry points; each names a module with ``configure(parser)`` and ``run(args)``."""

MEASURE, LOOK, USE, CERTIFY, CHECK, MORE = GROUPS = (
    "measure",
    "look",
    "use",
    "certify",
    "check plans",
    "more",
)

START_HERE = {
    "plan new -o PLAN.yaml": "asks, and writes plan and cell",
    "up --plan PLAN.yaml --simulate": "measure, here on a simulated machine",
    "solve BAG -o RESULT.json": "from a bag: the map and its U",
    "report RESULT.json": "all of it on one page",
    "help VERB": "options of a verb, and an example",
}
"""Commands of the first ten minutes -> what they are for."""


class Verb(NamedTuple):
    """A verb in ``selfcal --help``."""

    group: str
    what: str


VERBS = {
    "up": Verb(MEASURE, "start the nodes of a cell, and calibrate on one screen"),
    "monitor": Verb(
        MEASURE, "show a running cell on one screen, and operate it by keys"
    ),
    "call": Verb(MEASURE, "ask a running cell to start, confirm, redo, skip or abort"),
    "measure": Verb(MEASURE, "measure a plan with a machine, without ROS, and solve"),
    "cell": Verb(
        MEASURE, "try a machine, or check a cell before its first calibration"
    ),
    "camera": Verb(MEASURE, "find the pixel size, rotation and mirroring of a camera"),
    "detect": Verb(
        MEASURE, "find the marks in the images of a bag, or take a table of readings"
    ),
    "solve": Verb(MEASURE, "calibrate from a bag: MCAP file or rosbag2 folder"),
    "replay": Verb(
        MEASURE, "play a bag into the live nodes and take the map from them"
    ),
    "batch": Verb(MEASURE, "calibrate from many bags: one table, trends and changes"),
    "report": Verb(LOOK, "write a calibration report: one HTML or PDF file"),
    "plot": Verb(LOOK, "draw the maps of a result: png, svg or pdf"),
    "table": Verb(LOOK, "write the maps of a result as a table: csv or npz"),
    "diff": Verb(LOOK, "compare two results after removing the datum difference"),
    "recheck": Verb(
        LOOK, "has a calibrated stage changed? from one view of the same plate"
    ),
    "verify": Verb(
        LOOK, "is the machine better with the correction on, and if not, why not?"
    ),
    "history": Verb(
        LOOK, "the calibrations of a stage: active map, changes, when the next is due"
    ),
    "combine": Verb(LOOK, "combine several calibrations of a stage into one map"),
    "apply": Verb(USE, "correct a table of positions: true to commands, or back"),
    "export": Verb(USE, "write the map of a result as a table for a controller"),
    "cal": Verb(USE, "write, check and verify files for Aerotech controllers"),
    "gcode": Verb(USE, "correct a G-code program: for controllers without tables"),
    "certificate": Verb(
        CERTIFY, "write a digital calibration certificate: DCC 3.3.0 (XML)"
    ),
    "iso230": Verb(CERTIFY, "figures of ISO 230: accuracy, circularity, diagonals"),
    "plan": Verb(
        CHECK, "make a plan, check it before it is measured, or suggest views"
    ),
    "plate": Verb(
        CHECK, "draw the plate of a plan, true to size: svg, pdf, dxf or gds"
    ),
    "simulate": Verb(CHECK, "write a bag of a simulated cell, with its known truth"),
    "step-diagonal": Verb(MORE, "axis errors from a laser step-diagonal measurement"),
    "reproduce": Verb(MORE, "repeat the published simulations of Hu, Qiao or Ibaraki"),
}
"""Verbs; `step-diagonal` is the module ``step_diagonal.py`` of this package."""

EXAMPLES = {
    "up": "selfcal up --plan config/plans/hu.yaml --simulate",
    "monitor": "selfcal monitor --namespace cell_1",
    "call": "selfcal call start",
    "cell try": "selfcal cell try CELL.yaml",
    "cell check": "selfcal cell check --plan config/plans/hu.yaml",
    "measure": "selfcal measure config/plans/small.yaml config/cells/simulated.yaml "
    "-o measured --yes",
    "camera init": "selfcal camera init BAG -o nodes.yaml --mark-size 72e-6 --mark-pixels 12",
    "detect": "selfcal detect bags/camera -o marks --pixel-size 6e-6 --mark disc "
    "--mark-size 72e-6 --turn 1.5",
    "solve": "selfcal solve bags/hu_noise -o RESULT.json",
    "replay": "selfcal replay bags/hu_noise --fast -o RESULT.json",
    "batch": "selfcal batch bags/hu_noise bags/hu_exact -o batch",
    "report": "selfcal report RESULT.json -o report.html",
    "plot": "selfcal plot RESULT.json -o map.png",
    "table": "selfcal table RESULT.json -o map.csv",
    "diff": "selfcal diff RESULT.json LATER.json",
    "recheck": "selfcal recheck RESULT.json BAG -o LATER.json",
    "verify": "selfcal verify RESULT.json BAG --plot verified.png",
    "history": "selfcal history calibrations",
    "combine": "selfcal combine RESULT.json LATER.json -o MEAN.json",
    "apply": "selfcal apply RESULT.json points.csv -o commands.csv",
    "export": "selfcal export siemens RESULT.json -o table.ini --unit mm",
    "cal export": "selfcal cal export RESULT.json -o stage.cal --x-axis 1 --y-axis 2 --unit mm",
    "cal check": "selfcal cal check stage.cal",
    "cal eval": "selfcal cal eval stage.cal --position 1=10.5 --position 2=-3",
    "cal verify": "selfcal cal verify RESULT.json stage.cal",
    "cal accuracy": "selfcal cal accuracy RESULT.json -o accuracy.cal",
    "cal straightness": "selfcal cal straightness RESULT.json -o straightness.cal",
    "cal orthogonality": "selfcal cal orthogonality --measured 5um --over 200mm --travel 300mm "
    "--home middle -o square.cal",
    "gcode": "selfcal gcode part.nc RESULT.json -o corrected.nc --dialect linuxcnc",
    "certificate": "selfcal certificate RESULT.json config/certificates/details.yaml -o dcc.xml",
    "iso230": "selfcal iso230 RESULT.json",
    "plan new": "selfcal plan new -o stage.yaml --travel 120mm --marks 11 --pitch 10mm",
    "plan check": "selfcal plan check config/plans/hu.yaml --sigma 20nm",
    "plan suggest": "selfcal plan suggest config/plans/hu.yaml",
    "plate": "selfcal plate config/plans/hu.yaml -o plate.svg",
    "simulate": "selfcal simulate config/simulations/general.yaml -o simulated",
    "step-diagonal": "selfcal step-diagonal config/step_diagonal/case_study.csv --method new",
    "reproduce": "selfcal reproduce hu --draws 20",
}
"""Verb, with its second word if it has one -> a command for its help."""


def module_of(verb: str) -> str:
    """Return the module of a verb of this package."""
    return f"selfcal_ros.cli.{verb.replace('-', '_')}"


def verbs_of_others() -> dict[str, "EntryPoint"]:
    """Return the verbs that other installed packages register, by name."""
    from importlib.metadata import entry_points  # slow, and seldom needed

    return {
        point.name: point
        for point in entry_points(group=ENTRY_POINTS)
        if point.name not in VERBS and not point.value.startswith("selfcal_ros.")
    }


def summary_of(point: "EntryPoint") -> str:
    """Return what the help says of another package's verb, without importing it."""
    if point.dist is None:
        return point.value
    return (
        f"{point.dist.metadata['Summary'] or point.value} (package {point.dist.name})"
    )

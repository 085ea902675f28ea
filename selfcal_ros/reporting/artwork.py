# SPDX-License-Identifier: Apache-2.0
"""Artwork of a plate, true to size: outlines of its marks and lines, written as SVG, DXF or GDSII.

Plate axes, mm: x to the right, y upwards, the centre of the plate at (0, 0).
"""

import io
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.edge_markers import AWAY, DICTIONARY, SIDE, edge_markers
from selfcal_ros.model.view import Plan
from selfcal_ros.outputs import write_bytes, write_text
from selfcal_ros.reporting.figures.drawing import round_down
from selfcal_ros.units import MM_PER_M

AROUND = 180
"""Corners of a circle: its edge is true to 0.02 % of its radius."""

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}

KINDS = (".svg", ".pdf", ".dxf", ".gds")


@dataclass(frozen=True, eq=False)
class Artwork:
    """Filled outlines (P, 2) and texts of a plate, mm.

    `labels` are text, x, y of its left lower corner, and height of its letters.
    """

    outlines: list[np.ndarray]
    labels: list[tuple[str, float, float, float]]

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, lower, right and upper edge of the outlines and texts, with a margin."""
        written = [(x, y - 0.3 * size) for _, x, y, size in self.labels]
        points = np.concatenate([*self.outlines, *([written] if written else [])])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.03 * float((high - low).max())
        left, lower = low - margin
        right, upper = high + margin
        return float(left), float(lower), float(right), float(upper)


def artwork_of(
    plan: Plan, *, mark: str, size_m: float, width_m: float = 0.0, aruco: bool = False
) -> Artwork:
    """Return the artwork of the plate of a plan.

    Parameters
    ----------
    plan : Plan
        The plan; angular lines, if its plate has any, lie on a circle around the marks.
    mark : str
        ``disc``, ``ring``, ``cross`` or ``corner``, of the dimensions that `selfcal detect` takes.
    size_m, width_m : float
        Size of a mark and width of its line; 0 is a fifth of the size.
    aruco : bool
        Whether ArUco markers stand around the marks, see `selfcal_ros.model.edge_markers`.

    Raises
    ------
    InputError
        If the marks touch each other, their lines have no width or fill them, or there can be no
        markers.
    """
    plate = plan.artifact
    size = size_m * MM_PER_M
    places = np.stack([plate.x_m.ravel(), plate.y_m.ravel()], axis=1) * MM_PER_M
    nearest = _nearest(places)
    most = nearest / (3 if mark == "corner" else 1.5)  # two squares meet in a corner
    if not 0 < size <= most:
        raise InputError(
            "--mark-size",
            f"{size:g} mm, and the marks are {nearest:g} mm apart",
            f"give a size above 0 and of {most:.3g} mm at most, in m",
        )
    width = width_m * MM_PER_M or size / 5
    if not 0 < width < size / 2:
        raise InputError(
            "--mark-width",
            f"{width:g} mm, and a mark has {size:g} mm",
            f"give a width above 0 and below {size / 2:.3g} mm, in m",
        )
    shapes = _shapes(mark, size, width)
    outlines = [shape + place for place in places for shape in shapes]
    low, high = places.min(axis=0), places.max(axis=0)
    step = plate.grid_pitch_m * MM_PER_M if not plate.marks else nearest
    outlines.append(_circle(0.2 * step) + high + 0.75 * step)  # the corner (h, h)
    markers = _markers(plate, step) if aruco else []
    outlines += markers
    marker_reach_mm = (AWAY + SIDE / 2 if markers else 0) * step
    edge = float(np.hypot(*places.T).max()) + 1.5 * step + marker_reach_mm
    for angle in plate.theta_rad:
        turn = np.array(
            [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
        )
        outlines.append(
            (_box(step, step / 20) + np.array([edge + step / 2, 0.0])) @ turn
        )
    bottom = -(edge + step) if plate.angular_count else float(low[1]) - marker_reach_mm
    length = round_down(float(high[0] - low[0]) / 2)
    below = bottom - 1.5 * step
    left = float(low[0])
    outlines.append(_box(length, step / 10) + np.array([left + length / 2, below]))
    letters = 0.35 * step
    return Artwork(
        outlines,
        [
            (f"{length:g} mm", left, below + 0.2 * step, letters),
            (plan.plan_id, left, below - 0.6 * step, letters),
            *_numbers(plate, step, marker_reach_mm),
        ],
    )


def _numbers(
    plate: Artifact, step: float, marker_reach_mm: float
) -> Iterator[tuple[str, float, float, float]]:
    """Yield the numbers m below the columns of a lattice, and n to the left of its rows."""
    if plate.marks:
        return
    letters = 0.25 * step
    x = plate.x_m[:, 0] * MM_PER_M
    y = plate.y_m[0] * MM_PER_M
    for m, at in zip(plate.m[:, 0].tolist(), x.tolist(), strict=True):
        middle = at - 0.3 * letters * len(str(m))
        yield str(m), middle, float(y[0]) - marker_reach_mm - 0.8 * step, letters
    for n, at in zip(plate.n[0].tolist(), y.tolist(), strict=True):
        yield (
            str(n),
            float(x[0]) - marker_reach_mm - 0.9 * step,
            at - 0.35 * letters,
            letters,
        )


def _markers(plate: Artifact, step: float) -> list[np.ndarray]:
    """Return the black cells of the markers of a lattice, those side by side in one outline."""
    if plate.marks:
        raise InputError(
            "--aruco",
            "markers stand around a lattice, the plate is a list of marks",
            "leave --aruco out",
        )
    try:
        import cv2  # extra camera
    except ModuleNotFoundError as error:
        raise InputError(
            "--aruco",
            "OpenCV, which has the patterns, is not installed",
            "pip install 'selfcal_ros[camera]', or leave --aruco out",
        ) from error
    patterns = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    cells = patterns.markerSize + 2  # with its frame
    side = SIDE * step / cells
    outlines = []
    for number, centre in enumerate(edge_markers(*plate.shape) * step):
        black = cv2.aruco.generateImageMarker(patterns, number, cells) == 0
        for row, column, length in _runs(black):
            middle = (column + length / 2 - cells / 2, cells / 2 - row - 0.5)
            outlines.append(
                _box(length * side, side) + centre + np.array(middle) * side
            )
    return outlines


def _runs(black: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Yield row, first column and length of each run of black cells."""
    for row, cells in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]])))
        for first, end in edges.reshape(-1, 2).tolist():
            yield row, first, end - first


def _nearest(places: np.ndarray) -> float:
    """Return the smallest distance of two marks."""
    from scipy.spatial import KDTree  # for this verb only

    return float(KDTree(places).query(places, k=2)[0][:, 1].min())


def _shapes(mark: str, size: float, width: float) -> list[np.ndarray]:
    """Return the outlines of a mark at (0, 0)."""
    if mark == "disc":
        return [_circle(size / 2)]
    if mark == "ring":
        outer = _circle(size / 2)
        inner = _circle(size / 2 - width)
        return [np.concatenate([outer, outer[:1], inner[:1], inner[:0:-1], inner[:1]])]
    if mark == "cross":
        a, b = size / 2, width / 2
        return [
            np.array(
                [
                    (a, b),
                    (b, b),
                    (b, a),
                    (-b, a),
                    (-b, b),
                    (-a, b),
                    (-a, -b),
                    (-b, -b),
                    (-b, -a),
                    (b, -a),
                    (b, -b),
                    (a, -b),
                ]
            )
        ]
    side = size / 2
    to_square = np.array([side, -side])
    return [_box(size, size) + to_square, _box(size, size) - to_square]


def _circle(radius: float) -> np.ndarray:
    angle = np.arange(AROUND) * (2 * math.pi / AROUND)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _box(length: float, width: float) -> np.ndarray:
    a, b = length / 2, width / 2
    return np.array([(a, b), (-a, b), (-a, -b), (a, -b)])


def save_artwork(art: Artwork, path: str | os.PathLike, paper: str = "") -> None:
    """Write the artwork by the ending of `path`, on a sheet of paper if one is named.

    Raises
    ------
    InputError
        If the ending is unknown, the paper too small, or a package is not installed.
    """
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise InputError(
            str(path),
            "not a format of artwork by its suffix",
            f"name a file that ends in {', '.join(KINDS)}",
        )
    left, low, right, high = art.box
    if paper:
        across, along = PAPERS_MM[paper]
        if right - left > across or high - low > along:
            raise InputError(
                "--paper",
                f"the plate needs {right - left:.0f} x {high - low:.0f} mm, and "
                f"{paper} has {across:g} x {along:g} mm",
                "omit --paper, or plan a smaller plate",
            )
        x, y = (right + left) / 2, (high + low) / 2
        left = x - across / 2
        low = y - along / 2
        right = x + across / 2
        high = y + along / 2
    if kind == ".svg":
        write_text(path, _svg(art, (left, low, right, high)))
    elif kind == ".pdf":
        write_bytes(path, _pdf(art, (left, low, right, high)))
    else:
        write_bytes(path, (_dxf if kind == ".dxf" else _gds)(art))


def _svg(art: Artwork, box: tuple[float, float, float, float]) -> str:
    """Return an SVG in mm, y downwards."""
    left, low, right, high = box
    path = "".join(
        "M" + "L".join(f"{x - left:.6f},{high - y:.6f}" for x, y in outline) + "Z"
        for outline in art.outlines
    )
    texts = "".join(
        f'<text x="{x - left:.3f}" y="{high - y:.3f}" font-size="{size:.3f}" '
        f'font-family="sans-serif">{escape(text)}</text>\n'
        for text, x, y, size in art.labels
    )
    width, height = right - left, high - low
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.6f}mm" '
        f'height="{height:.6f}mm" viewBox="0 0 {width:.6f} {height:.6f}">\n'
        f'<path d="{path}"/>\n{texts}</svg>\n'
    )


def _pdf(art: Artwork, box: tuple[float, float, float, float]) -> bytes:
    """Return a PDF, true to size."""
    from matplotlib.collections import PolyCollection  # heavy
    from matplotlib.figure import Figure  # heavy

    left, low, right, high = box
    page = Figure(figsize=((right - left) / 25.4, (high - low) / 25.4))
    axes = page.add_axes((0, 0, 1, 1))
    axes.set(xlim=(left, right), ylim=(low, high))
    axes.set_axis_off()
    axes.add_collection(
        PolyCollection(art.outlines, facecolor="black", linewidth=0), autolim=False
    )
    for text, x, y, size in art.labels:
        axes.text(x, y, text, fontsize=size / 25.4 * 72, parse_math=False)
    data = io.BytesIO()
    page.savefig(data, format="pdf", metadata={"CreationDate": None})
    return data.getvalue()


def _dxf(art: Artwork) -> bytes:
    """Return a DXF in mm: closed polylines and texts."""
    try:
        import ezdxf  # an extra
    except ModuleNotFoundError as error:
        raise _missing("DXF", "ezdxf") from error
    drawing = ezdxf.new(units=4)  # mm
    space = drawing.modelspace()
    for outline in art.outlines:
        space.add_lwpolyline(outline.tolist(), close=True)
    for text, x, y, size in art.labels:
        space.add_text(text, height=size).set_placement((x, y))
    stream = io.StringIO()
    drawing.write(stream)
    return stream.getvalue().encode()


def _gds(art: Artwork) -> bytes:
    """Return a GDSII, user unit 1 um, grid 1 nm: polygons on layer 0, texts as polygons on 1."""
    try:
        import gdstk  # an extra
    except ModuleNotFoundError as error:
        raise _missing("GDSII", "gdstk") from error
    library = gdstk.Library(unit=1e-6, precision=1e-9)
    cell = library.new_cell("PLATE")
    for outline in art.outlines:
        cell.add(gdstk.Polygon([complex(x, y) for x, y in outline * 1e3]))
    for text, x, y, size in art.labels:
        cell.add(*gdstk.text(text, size * 1e3, (x * 1e3, y * 1e3), layer=1))
    with TemporaryDirectory() as folder:
        file = Path(folder) / "plate.gds"
        library.write_gds(file)
        return file.read_bytes()


def _missing(format_name: str, package: str) -> InputError:
    return InputError(
        format_name,
        f"the package {package} is not installed",
        f"pip install {package}, or write .svg or .pdf",
    )

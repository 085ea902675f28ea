# SPDX-License-Identifier: Apache-2.0
"""Marks in images of 1280 x 1024 pixels: time and error, beside OpenCV's own detectors.

The error is also given over the Cramér-Rao bound for known noise, from the drawn image and its
differences, not from the detector's model.
"""

import resource
import time
from dataclasses import replace
from functools import cache
from importlib.util import find_spec

import numpy as np
from scipy.spatial import KDTree
from timing import median_time

from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.simulation.rendering import Camera
from selfcal_ros.vision.detector import MarkDetector
from selfcal_ros.vision.images import Picture

OURS = "selfcal"
RIVALS = {"disc": "opencv SimpleBlobDetector", "corner": "opencv cornerSubPix"}
RATIOS = (10, 50, 200)
"""Contrast over noise."""
SIZE_PX, PIXEL_M, SHIFT_PX = 25.0, 2e-6, 0.05
CONTRAST = 0.6
CORNER_PX = 17.0
"""Radius of the part of a corner that is used."""


def camera(mark: str, ratio: float) -> Camera:
    """Return the camera of a row; noise is that of reading alone."""
    return Camera(
        width=1280,
        height=1024,
        pixel_size_m=PIXEL_M,
        mark=mark,
        contrast=CONTRAST,
        mark_size_m=SIZE_PX * PIXEL_M,
        mark_width_m=SIZE_PX * PIXEL_M / 5,
        read_noise=CONTRAST / ratio,
        shot_noise=0.0,
        encoding="mono16",
    )


def drawn(
    mark: str, ratio: float, number: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return images of nine marks at random phases, and the places of the marks (9, 2), px."""
    rng, cell = np.random.default_rng(int(ratio)), camera(mark, ratio)
    lattice = np.stack(np.meshgrid([-300, 0, 300], [-300, 0, 300])).reshape(2, -1)
    images, places = [], []
    for _ in range(number):
        offsets = (lattice + rng.uniform(-20, 20, (2, 9))) * PIXEL_M
        images.append(cell.image(offsets, rng))
        places.append(cell.pixels_of(offsets).T)
    return images, places


@cache
def bound_px(mark: str, ratio: float) -> float:
    """Return the Cramér-Rao bound of a coordinate of a mark, px."""
    cell = replace(camera(mark, ratio), width=81, height=81, read_noise=0.0)
    rng, shift = np.random.default_rng(0), np.array([[SHIFT_PX * PIXEL_M], [0.0]])
    plus, minus = (cell.image(sign * shift, rng) / cell.full_scale for sign in (1, -1))
    slope = (plus - minus) / (2 * SHIFT_PX)
    if mark == "corner":  # the squares meet in it, and end elsewhere
        row, column = np.mgrid[-40:41, -40:41]
        slope = slope[np.hypot(row, column) <= CORNER_PX]
    return CONTRAST / ratio / float(np.sqrt(np.square(slope).sum()))


def ours(mark: str, images: list[np.ndarray]) -> list[np.ndarray]:
    """Return the places found by this package, px."""
    detector = MarkDetector(
        DetectorSettings(pixel_size=PIXEL_M, mark=mark, mark_size=SIZE_PX * PIXEL_M)
    )
    return [
        np.array(
            [(found.u, found.v) for found in detector.marks(Picture(image, 65535))[0]]
        ).reshape(-1, 2)
        for image in images
    ]


def opencv(mark: str, images: list[np.ndarray]) -> list[np.ndarray]:
    """Return the places found by OpenCV, px."""
    import cv2

    cv2.setNumThreads(1)
    found = []
    for image in images:
        grey = (image >> 8).astype(np.uint8)
        if mark == "disc":
            wanted = cv2.SimpleBlobDetector_Params()
            wanted.minArea, wanted.maxArea, wanted.blobColor = 200.0, 1000.0, 0
            places = cv2.SimpleBlobDetector_create(wanted).detect(grey)
            found.append(np.array([place.pt for place in places]).reshape(-1, 2))
        else:
            first = ours(mark, [image])[0]  # it refines given corners
            corners = np.rint(first).astype(np.float32).reshape(-1, 1, 2)
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
            found.append(
                cv2.cornerSubPix(grey, corners, (8, 8), (-1, -1), criteria).reshape(
                    -1, 2
                )
            )
    return found


def missed_px(found: list[np.ndarray], places: list[np.ndarray]) -> np.ndarray:
    """Return the error of each place that was found within 2 px, (n, 2)."""
    out = [np.zeros((0, 2))]
    for mine, true in zip(found, places, strict=True):
        if len(mine):
            away, near = KDTree(mine).query(true)
            out.append(mine[near[away < 2]] - true[away < 2])
    return np.concatenate(out)


def rows(number: int):
    """Yield a row for each kind of mark, noise and method."""
    for mark in ("disc", "ring", "cross", "corner"):
        for ratio in RATIOS:
            images, places = drawn(mark, ratio, number)
            for method in (OURS, *([RIVALS[mark]] if mark in RIVALS else [])):
                row = {
                    "benchmark": f"detect {mark} {ratio}",
                    "method": method,
                    "n": number,
                    "seconds": None,
                    "peak_mb": None,
                    "max_error": None,
                }
                if method != OURS and find_spec("cv2") is None:
                    yield {**row, "note": "not installed"}
                    continue
                find = ours if method == OURS else opencv
                began = time.process_time()
                found = find(mark, images)
                cpu = (time.process_time() - began) / number
                missed = missed_px(found, places)
                seconds, _ = median_time(
                    lambda find=find, mark=mark, image=images[:1]: find(mark, image),
                    once=False,
                )
                yield {
                    **row,
                    "seconds": seconds,
                    "cpu_seconds": cpu,
                    "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                    / 1024,
                    "max_error": float(np.abs(missed).max(initial=0.0)) * PIXEL_M,
                    "found": len(missed) / (9 * number),
                    "rms_px": float(np.sqrt(np.square(missed).mean()))
                    if len(missed)
                    else None,
                    "bound_px": bound_px(mark, ratio),
                }


MANY = (10, 32, 84)
"""Marks along a side of the images with many marks: 100, some 1,000, some 7,000."""
MANY_SIZE_PX, MANY_PITCH_PX, MANY_RATIO = 13.0, 26, 50
"""As in a photograph of a lithographic dot grid."""


def drawn_many(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an image of side x side marks at random phases, and their places (n, 2), px."""
    rng = np.random.default_rng(side)
    width = MANY_PITCH_PX * (side + 1)
    cell = replace(
        camera("disc", MANY_RATIO),
        width=width,
        height=width,
        mark_size_m=MANY_SIZE_PX * PIXEL_M,
    )
    along = (np.arange(side) - (side - 1) / 2) * MANY_PITCH_PX
    lattice = np.stack(np.meshgrid(along, along)).reshape(2, -1)
    offsets = (lattice + rng.uniform(-0.5, 0.5, lattice.shape)) * PIXEL_M
    return cell.image(offsets, rng), cell.pixels_of(offsets).T


def ours_many(image: np.ndarray) -> np.ndarray:
    """Return the places found by this package, px."""
    detector = MarkDetector(
        DetectorSettings(
            pixel_size=PIXEL_M,
            mark="disc",
            mark_size=MANY_SIZE_PX * PIXEL_M,
            max_marks=image.size,
        )
    )
    return np.array(
        [(found.u, found.v) for found in detector.marks(Picture(image, 65535))[0]]
    )


def opencv_many(image: np.ndarray) -> np.ndarray:
    """Return the places found by OpenCV's blob finder, px."""
    import cv2

    cv2.setNumThreads(1)
    wanted = cv2.SimpleBlobDetector_Params()
    wanted.minArea, wanted.maxArea, wanted.blobColor = 60.0, 300.0, 0
    places = cv2.SimpleBlobDetector_create(wanted).detect((image >> 8).astype(np.uint8))
    return np.array([place.pt for place in places]).reshape(-1, 2)


def labels_many(image: np.ndarray) -> np.ndarray:
    """Return the centroids of the dark parts that scipy labels, px."""
    from scipy import ndimage

    level = (float(image.min()) + float(np.median(image))) / 2
    labels, number = ndimage.label(image < level)
    centres = ndimage.center_of_mass(labels > 0, labels, np.arange(1, number + 1))
    return np.array(centres).reshape(-1, 2)[:, ::-1]


def rows_of_many():
    """Yield a row for each number of marks in an image and each method."""
    methods = {
        OURS: ours_many,
        RIVALS["disc"]: opencv_many,
        "scipy labels": labels_many,
    }
    for side in MANY:
        image, places = drawn_many(side)
        for method, find in methods.items():
            row = {
                "benchmark": "detect many",
                "method": method,
                "n": side * side,
                "seconds": None,
                "peak_mb": None,
                "max_error": None,
            }
            if method == RIVALS["disc"] and find_spec("cv2") is None:
                yield {**row, "note": "not installed"}
                continue
            began = time.process_time()
            found = find(image)
            cpu = time.process_time() - began
            missed = missed_px([found], [places])
            seconds, _ = median_time(
                lambda find=find, image=image: find(image), once=False
            )
            yield {
                **row,
                "seconds": seconds,
                "cpu_seconds": cpu,
                "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                "max_error": float(np.abs(missed).max(initial=0.0)) * PIXEL_M,
                "found": len(missed) / side**2,
                "rms_px": float(np.sqrt(np.square(missed).mean()))
                if len(missed)
                else None,
                "bound_px": None,
            }


def show(row: dict) -> None:
    """Print one line of the table."""
    print(
        f"{row['benchmark']:<17} {row['method']:<36} {row['n']:>7} {row['seconds']:12.6f} "
        f"{row['peak_mb']:10.0f} {row['max_error']:12.1e} {row['cpu_seconds']:10.3f}  "
        f"{row['found']:.1%} found, rms {row['rms_px']:.4f} px"
        + (
            f", {row['rms_px'] / row['bound_px']:.2f} of the bound"
            if row["bound_px"]
            else ""
        ),
        flush=True,
    )

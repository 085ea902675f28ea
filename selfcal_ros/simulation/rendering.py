# SPDX-License-Identifier: Apache-2.0
"""Images of a simulated camera: exposures, shapes of marks, blur, pixels, light, noise, dirt.

Shapes are drawn on a grid several times finer than the pixels, blurred there and averaged over
each pixel; the detector's models are not used.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import groupby

import numpy as np

from selfcal_ros.collection.inputs import Command, Detection, Kind
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.cell import Event
from selfcal_ros.simulation.machine import Truth

FINE = 8
"""Points of the fine grid along a pixel."""
LARGEST_MARK_PX = 2000
DIRT_RADIUS = (0.05, 0.2)
"""Range of the radius of dirt, in sizes of a mark."""


@dataclass(frozen=True)
class Camera:
    """A camera and the marks in its images; grey values over the full scale, 0 to 1.

    Attributes
    ----------
    width, height : int
        Size of the image, px.
    pixel_size_m : float
        Side of a pixel on the plate.
    mark : str
        ``disc``, ``ring``, ``cross`` or ``corner``.
    mark_size_m, mark_width_m : float
        As the parameters of mark_detector.
    polarity : str
        ``dark`` or ``bright``.
    turn_deg, mirror
        As the parameters of mark_detector.
    blur_px : float
        Standard deviation of the point spread.
    ground, contrast : float
        Grey value of the ground, and its absolute difference to the marks.
    read_noise, shot_noise : float
        Standard deviation of dark pixels, and that added by light at full scale.
    vignetting : float
        Relative loss of light in the corners of the image.
    distortion : float
        Relative radial displacement of marks in the corners.
    dirt : float
        Mean number of specks per image.
    encoding : str
        ``mono8`` or ``mono16``.

    Raises
    ------
    InputError
        For sizes that are not positive, or a mark of more than `LARGEST_MARK_PX` pixels.
    """

    width: int = 96
    height: int = 96
    pixel_size_m: float = 2e-6
    mark: str = "disc"
    mark_size_m: float = 50e-6
    mark_width_m: float = 10e-6
    polarity: str = "dark"
    turn_deg: float = 0.0
    mirror: bool = False
    blur_px: float = 1.0
    ground: float = 0.8
    contrast: float = 0.6
    read_noise: float = 0.005
    shot_noise: float = 0.01
    vignetting: float = 0.0
    distortion: float = 0.0
    dirt: float = 0.0
    encoding: str = "mono8"

    def __post_init__(self) -> None:
        """Refuse impossible sizes."""
        if min(self.pixel_size_m, self.mark_size_m, self.mark_width_m) <= 0:
            raise InputError(
                "camera", "a size is 0", "give pixel_size, mark_size and mark_width"
            )
        if self.mark_size_m > LARGEST_MARK_PX * self.pixel_size_m:
            raise InputError(
                "camera: mark_size",
                f"{self.mark_size_m / self.pixel_size_m:.3g} pixels",
                f"a mark has up to {LARGEST_MARK_PX} pixels; correct mark_size or"
                " pixel_size",
            )

    @property
    def full_scale(self) -> int:
        """Largest grey value."""
        return 65535 if self.encoding == "mono16" else 255

    @property
    def reach_m(self) -> float:
        """Distance from the axis beyond which no mark touches the image, twice over."""
        side = np.hypot(self.width, self.height) * self.pixel_size_m
        return float(side + 2 * self.mark_size_m)

    def pixels_of(self, offsets: np.ndarray) -> np.ndarray:
        """Return column and row (2, n) of points at offsets (2, n) from the optical axis, m."""
        turn = np.deg2rad(self.turn_deg)
        back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        right, up = back @ offsets / self.pixel_size_m
        if self.mirror:
            right = -right
        centre = np.array([[(self.width - 1) / 2], [(self.height - 1) / 2]])
        out = np.stack([right, -up])
        return centre + out * (
            1 + self.distortion * np.square(out).sum(axis=0) / np.square(centre).sum()
        )

    def image(
        self,
        offsets: np.ndarray,
        rng: np.random.Generator,
        *,
        angles: Sequence[float] | float = 0.0,
    ) -> np.ndarray:
        """Return an image (height, width) of marks at `offsets` (2, n), m, with noise and dirt.

        Parameters
        ----------
        offsets : float array (2, n)
            Of the marks from the optical axis, stage axes.
        rng
            Source of noise and dirt.
        angles : float or (n,)
            Directions of their first bars or edges, stage axes, rad.
        """
        sign = 1 if self.polarity == "bright" else -1
        grey = np.full((self.height, self.width), self.ground)
        size = self.mark_size_m / self.pixel_size_m
        for (u, v), angle in zip(
            self.pixels_of(offsets).T,
            np.broadcast_to(angles, offsets.shape[1]),
            strict=True,
        ):
            self._add(
                grey,
                u,
                v,
                size,
                np.deg2rad(self.turn_deg) - angle,
                sign * self.contrast,
            )
        for _ in range(rng.poisson(self.dirt) if self.dirt else 0):
            u, v = rng.uniform(0, self.width), rng.uniform(0, self.height)
            self._speck(grey, u, v, 2 * size * rng.uniform(*DIRT_RADIUS))
        light = np.clip(grey, 0.0, None) * self._lighting
        spread = np.sqrt(self.read_noise**2 + self.shot_noise**2 * light)
        value = (light + spread * rng.normal(size=light.shape)) * self.full_scale
        return np.clip(np.rint(value), 0, self.full_scale).astype(
            np.uint16 if self.encoding == "mono16" else np.uint8
        )

    @cached_property
    def _lighting(self) -> np.ndarray:
        """Share of the light that reaches each pixel, (height, width)."""
        v, u = np.mgrid[0 : self.height, 0 : self.width]
        right, down = u - (self.width - 1) / 2, v - (self.height - 1) / 2
        return 1 - self.vignetting * (right**2 + down**2) / (
            right[0, 0] ** 2 + down[0, 0] ** 2
        )

    def _add(
        self,
        grey: np.ndarray,
        u: float,
        v: float,
        size: float,
        angle: float,
        contrast: float,
    ) -> None:
        """Add a blurred mark at column `u` and row `v`."""
        half = (
            int(
                np.ceil(
                    (1.5 if self.mark == "corner" else 0.75) * size + 4 * self.blur_px
                )
            )
            + 2
        )
        width = self.mark_width_m / self.pixel_size_m
        self._stamp(
            grey,
            u,
            v,
            half,
            lambda a, b: distance(self.mark, a, b, size, width),
            contrast,
            angle,
        )

    def _speck(self, grey: np.ndarray, u: float, v: float, size: float) -> None:
        self._stamp(
            grey,
            u,
            v,
            int(np.ceil(size + 4 * self.blur_px)) + 2,
            lambda a, b: distance("disc", a, b, size, 0.0),
            -0.9 * self.ground,
            0.0,
        )

    def _stamp(
        self,
        grey: np.ndarray,
        u: float,
        v: float,
        half: int,
        inside: "Distance",
        contrast: float,
        angle: float,
    ) -> None:
        column, row = round(u), round(v)
        first_row, first_column = row - half, column - half
        rows = slice(max(first_row, 0), min(first_row + 2 * half + 1, self.height))
        columns = slice(
            max(first_column, 0), min(first_column + 2 * half + 1, self.width)
        )
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        step = (np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5 - half
        b, a = step - (v - row), step - (u - column)
        a = -a if self.mirror else a
        cosine, sine = np.cos(angle), np.sin(angle)  # from columns to rows
        cover = inside(
            np.add.outer(sine * b, cosine * a), np.subtract.outer(cosine * b, sine * a)
        )
        cover *= FINE
        cover += 0.5
        np.clip(cover, 0, 1, out=cover)
        along = blurred_pixels(2 * half + 1, self.blur_px)
        pixels = along @ cover @ along.T
        grey[rows, columns] += (
            contrast
            * pixels[
                rows.start - first_row : rows.stop - first_row,
                columns.start - first_column : columns.stop - first_column,
            ]
        )


@cache
def blurred_pixels(count: int, blur_px: float) -> np.ndarray:
    """Return the means over `count` pixels of a blurred line of `FINE` points each, as a matrix.

    What lies beyond either end is as the last point there.

    Returns
    -------
    float array (count, count * FINE)
    """
    sigma, n = blur_px * FINE, count * FINE
    away = np.arange(-int(5 * sigma + 0.5), int(5 * sigma + 0.5) + 1)
    weight = np.exp(-((away / max(sigma, np.finfo(float).tiny)) ** 2) / 2)
    point = np.arange(n)[:, None]
    means = np.zeros((count, n))
    np.add.at(
        means,
        (point // FINE, np.clip(point + away, 0, n - 1)),
        weight / weight.sum() / FINE,
    )
    return means


Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Distance of points to the edge of a shape, positive inside, px."""


def _box(a: np.ndarray, b: np.ndarray, length: float, width: float) -> np.ndarray:
    return np.minimum(length / 2 - np.abs(a), width / 2 - np.abs(b))


def distance(
    mark: str, a: np.ndarray, b: np.ndarray, size: float, width: float
) -> np.ndarray:
    """Return the distance of points to the edge of a mark, positive inside, px.

    A corner is where two squares of side `size` meet.
    """
    if mark == "disc":
        return size / 2 - np.sqrt(a * a + b * b)  # hypot takes four times as long
    if mark == "ring":
        return width / 2 - np.abs(np.sqrt(a * a + b * b) - (size - width) / 2)
    if mark == "cross":
        return np.maximum(_box(a, b, size, width), _box(a, b, width, size))
    return np.maximum(
        _box(a - size / 2, b - size / 2, size, size),
        _box(a + size / 2, b + size / 2, size, size),
    )


@dataclass(frozen=True)
class Exposure:
    """An image to be rendered.

    Attributes
    ----------
    stamp_ns : int
        Its instant.
    offsets : float array (2, n)
        Offsets of its marks from the optical axis, stage axes, m.
    angle : float
        Direction of the plate's x axis, stage axes, rad.
    """

    stamp_ns: int
    offsets: np.ndarray
    angle: float


def exposures(
    truth: Truth, plan: Plan, camera: Camera, events: Iterable[Event], *, sense: Sense
) -> Iterator[Event | Exposure]:
    """Yield `events` with an exposure for all grid detections of a stamp, which name their marks.

    The detected marks are at their offsets; the others lie around the first one as on the plate,
    turned by the yaw of the stage there, seen through the same microscope.
    """
    if truth.artifact.marks:
        raise InputError(
            "camera",
            "images are rendered of lattices, the plate is a list of marks",
            "simulate detections instead",
        )
    artifact, reach = truth.artifact, camera.reach_m
    m, n = physics.all_marks(artifact)
    i, j = artifact.middle
    place = np.zeros((2, 0))
    index = -1
    angle = 0.0
    for _, group in groupby(
        events, key=lambda event: (event.stamp_ns, _is_grid(event))
    ):
        simultaneous = list(group)
        for event in simultaneous:
            if (
                isinstance(event, Command)
                and event.view is not None
                and event.view_index != index
            ):
                index = event.view_index
                view = truth.placed_as(index, event.view)
                place, _ = physics.mark_places(truth, index, view, (m, n))
                angle = float(view.rotation_rad + truth.phi_rad[index])
        offset_of_mark = {
            (event.m + i) * artifact.shape[1] + event.n + j: (
                event.offset_x,
                event.offset_y,
            )
            for event in simultaneous
            if isinstance(event, Detection) and _is_grid(event)
        }
        if not offset_of_mark:
            yield from simultaneous
            continue
        first = next(iter(offset_of_mark))
        away = place - place[:, [first]]
        stage = place[:, [first]]
        away = physics.with_yaw(
            truth, sense, -stage if sense is Sense.PLATE_MOVES else stage, away
        )
        offsets = np.array([offset_of_mark[first]]).T + physics.seen_offset(truth, away)
        offsets[:, list(offset_of_mark)] = np.array(list(offset_of_mark.values())).T
        yield Exposure(
            simultaneous[0].stamp_ns, offsets[:, np.hypot(*away) < reach], angle
        )


def _is_grid(event: Event) -> bool:
    return isinstance(event, Detection) and event.kind == Kind.GRID

# SPDX-License-Identifier: Apache-2.0
"""What a result keeps beside its maps, so that their covariances follow from its file alone."""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import numpy as np

from selfcal_ros.files import read
from selfcal_ros.outputs import plain

FACTORS, ANGULAR, ADDED, IMAGES, COVARIANCE = KEYS = (
    "covariance_terms",
    "angular_terms",
    "first_order_added",
    "images",
    "map_covariance",
)
"""Keys in RESULT.json."""

LACK_OF_FIT = "lack_of_fit"
"""Name of the effect of what residuals have beyond the scatter of repeats."""

ROUGHNESS = "roughness"
"""Name of the effect of what the nodes of a map do not follow."""

REVERSAL = "reversal"
"""Name of the effect of a direction of approach that does not do the same everywhere."""

OF_EACH_PLACE = (LACK_OF_FIT, ROUGHNESS, REVERSAL)
"""Effects that have a sign of their own at each place."""

NOISE = "noise"
"""Name of the effect of views that are noisier than the others."""

DIGITS = 7
"""Digits that are kept of a number."""

LEAST = 1e-12
"""Smallest number that is kept: smaller ones are rounding."""


def rounded(values: np.ndarray) -> np.ndarray:
    """Return values rounded to `DIGITS` digits, none smaller than `LEAST`.

    As quotients of an exact power of ten, so that they print with no more digits.
    """
    size = np.abs(values)
    digits = DIGITS - 1 - np.floor(np.log10(np.maximum(size, LEAST)))
    power = 10.0 ** np.maximum(digits, 0.0)
    return np.where(size < LEAST, 0.0, np.round(values * power) / power)


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the known values of a map, Gx, then Gy, or Gtheta.

    Attributes
    ----------
    lower : float array (n (n + 1) / 2,)
        Its lower triangle, in units of `scale`.
    scale : float
        m^2 or rad^2.
    """

    lower: np.ndarray
    scale: float

    @classmethod
    def of(cls, matrix: np.ndarray) -> "Covariance":
        """Return that of a matrix (n, n), rounded."""
        scale = float(np.diag(matrix).mean()) or 1.0  # of readings without noise
        return cls(rounded(matrix[np.tril_indices(len(matrix))] / scale), scale)

    def matrix(self, n: int) -> np.ndarray:
        """Return it in full, (n, n); ValueError if it is not of n values."""
        full = np.zeros((n, n))
        full[np.tril_indices(n)] = self.lower.reshape(n * (n + 1) // 2) * self.scale
        return full + np.tril(full, -1).T


@dataclass(frozen=True, eq=False)
class Factors:
    """What terms of the model, and effects beside it, make of the maps, for unit noise.

    Unit noise is that of one grid reading; all is in the stage frame.

    Attributes
    ----------
    terms : tuple of str
        The term, or the effect, that each factor belongs to.
    of_map : float array (r, 2, nx, ny)
        Factors L of the covariance L' L of Gx, then Gy. Those `of_each_place` add to its diagonal
        alone; those `of_size` make the covariance of noise and terms larger as a whole.
    beside : dict of float array (s, ...)
        What each factor makes of other quantities: `plate` (s, 2, nx, ny), as those of the map;
        `lines` (s, 2, K), the angular maps of stage and plate, and those of the block of the
        offsets, (s, 4), its coefficients, both times the longer half width of the plate. Empty:
        not kept.
    with_map : int
        So many of `beside` belong to the first factors of the map, the others leave it as it is.
    on_plate : float array (2, nx, ny), optional
        What effects that are not terms of the model add to the variance of the plate's map.
    beside_terms : tuple of str
        The term that each of those of `beside` belongs to that leave the map as it is; empty where
        an older file does not say it.
    """

    terms: tuple[str, ...]
    of_map: np.ndarray
    beside: Mapping[str, np.ndarray] = field(default_factory=dict)
    with_map: int = 0
    on_plate: np.ndarray | None = None
    beside_terms: tuple[str, ...] = ()

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "Factors":
        """Return that there is none on a map of this shape."""
        return cls((), np.zeros((0, 2, *shape)))

    @property
    def of_each_place(self) -> np.ndarray:
        """Factors of `OF_EACH_PLACE`, bool (r,)."""
        return np.isin(self.terms, OF_EACH_PLACE)

    @property
    def of_size(self) -> np.ndarray:
        """Factors of what is more of the same noise: it has no sign, bool (r,)."""
        return np.isin(self.terms, NOISE)

    @property
    def of_fields(self) -> np.ndarray:
        """Factors that are fields, with a sign that all places share, bool (r,)."""
        return ~(self.of_each_place | self.of_size)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        out: dict[str, Any] = {"terms": list(self.terms), "factors": plain(self.of_map)}
        if self.beside:
            out["beside"] = {
                "with_map": self.with_map,
                "terms": list(self.beside_terms),
                **plain(dict(self.beside)),
            }
        if self.on_plate is not None:
            out["effects_on_plate"] = plain(self.on_plate)
        return out


@dataclass(frozen=True)
class SlowKept:
    """Noises of images that move slowly, as variances over that of a reading.

    Attributes
    ----------
    mark : float
        Of a mark by itself.
    white, slow : float
        Of the motion that the marks of an image share: white, and with a power of 1/f.
    """

    mark: float
    white: float
    slow: float


@dataclass(frozen=True)
class ImagesKept:
    """Noise of images with several marks.

    Attributes
    ----------
    share : float
        Part of the variance of a reading that the marks of an image have in common.
    dof_mark : float
        Degrees of freedom of the noise of a mark by itself.
    placing : tuple of int
        Number of the placing of the plate in each grid view.
    step : tuple of (int, int)
        Step (m, n) of the cell of each grid view on the plate.
    motion : SlowKept, optional
        In place of `share` where the images move slowly.
    """

    share: float
    dof_mark: float
    placing: tuple[int, ...]
    step: tuple[tuple[int, int], ...]
    motion: SlowKept | None = None


@dataclass(frozen=True, eq=False)
class Kept:
    """All that a result keeps for the covariances of its maps.

    Attributes
    ----------
    factors : Factors, optional
        Of terms and effects; None without, or where the field is too large.
    angular : dict of float array (K,)
        Contribution of each term and effect to the standard uncertainty of the angular map, rad.
    added : float array (2,), optional
        What unequal noise adds to the variances of O and R times the half width, unit noise.
    images : ImagesKept, optional
        Of readings that come from images with several marks.
    covariances : dict of Covariance
        ``xy``, ``theta`` -> that of a mean map or of a recheck.
    """

    factors: Factors | None = None
    angular: Mapping[str, np.ndarray] = field(default_factory=dict)
    added: np.ndarray | None = None
    images: ImagesKept | None = None
    covariances: Mapping[str, Covariance] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form: the keys of what there is."""
        sections = {
            ADDED: self.added,
            FACTORS: self.factors and self.factors.to_dict(),
            ANGULAR: dict(self.angular) or None,
            IMAGES: self.images,
            COVARIANCE: {
                key: value
                for kind, covariance in self.covariances.items()
                for key, value in (
                    (kind, covariance.lower),
                    (f"scale_{kind}", covariance.scale),
                )
            }
            or None,
        }
        return {
            key: plain(section)
            for key, section in sections.items()
            if section is not None
        }


def kept_from_dict(
    data: Mapping[str, Any],
    of_map: tuple[int, ...],
    of_plate: tuple[int, ...],
    lines: int,
) -> Kept:
    """Return what a result keeps from its JSON form.

    Parameters
    ----------
    data : dict
        The result.
    of_map, of_plate : tuple of int
        Shapes of both maps.
    lines : int
        K.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is damaged.
    """
    images = read(ImagesKept | None, data.get(IMAGES))
    if images is not None and math.isnan(images.dof_mark):  # JSON has no infinity
        images = replace(images, dof_mark=math.inf)
    if images is not None and not (
        0 <= images.share <= 1
        and images.dof_mark >= 0
        and all(len(step) == 2 for step in images.step)
        and (images.motion is None or all(v >= 0 for v in astuple(images.motion)))
    ):
        raise ValueError(f"{IMAGES}: no noise of images")
    return Kept(
        _factors(data[FACTORS], of_map, of_plate, lines) if FACTORS in data else None,
        {
            name: _numbers(
                u, (lines,), ANGULAR, "no contributions to these lines", finite=False
            )
            for name, u in read(dict, data.get(ANGULAR, {})).items()
        },
        _numbers(data[ADDED], (2,), ADDED, "not two variances")
        if ADDED in data
        else None,
        images,
        {
            kind: Covariance(
                _numbers(stored[kind], (-1,), COVARIANCE, "not a triangle of numbers"),
                read(float, stored[f"scale_{kind}"]),
            )
            for stored in (read(dict, data.get(COVARIANCE, {})),)
            for kind in ("xy", "theta")
            if kind in stored
        },
    )


def _factors(
    data: Any, of_map: tuple[int, ...], of_plate: tuple[int, ...], lines: int
) -> Factors:
    fields = read(dict, data)
    terms = read(tuple[str, ...], fields["terms"])
    factors = _numbers(
        fields["factors"],
        (len(terms), 2, *of_map),
        FACTORS,
        "no factors of this lattice",
    )
    shapes = {"plate": (2, *of_plate), "lines": (2, lines)}
    quantities = dict(read(dict, fields.get("beside", {})))
    with_map = read(int, quantities.pop("with_map", 0))
    beside_terms = read(tuple[str, ...], quantities.pop("terms", []))
    quantity_values = {}
    for name, values in quantities.items():
        quantity_values[name] = _numbers(
            values,
            (len(read(list, values)), *shapes.get(name, (4,))),
            FACTORS,
            f"no {name} of this plate",
        )
    numbers = {len(values) for values in quantity_values.values()}
    if quantity_values and (
        len(numbers) > 1 or not 0 <= with_map <= min(*numbers, len(terms))
    ):
        raise ValueError(f"{FACTORS}: quantities beside the map of other factors")
    if beside_terms and numbers != {with_map + len(beside_terms)}:
        raise ValueError(f"{FACTORS}: other terms than quantities beside the map")
    on_plate = fields.get("effects_on_plate")
    return Factors(
        terms,
        factors,
        quantity_values,
        with_map,
        None
        if on_plate is None
        else _numbers(on_plate, (2, *of_plate), FACTORS, "no effects on the plate"),
        beside_terms,
    )


def _numbers(
    value: Any, shape: tuple[int, ...], where: str, wrong: str, *, finite: bool = True
) -> np.ndarray:
    """Return numbers of a shape; ValueError says where they are wrong, and what is."""
    try:
        numbers = read(np.ndarray, value).reshape(shape)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {wrong}") from error
    if finite and not np.isfinite(numbers).all():
        raise ValueError(f"{where}: {wrong}")
    return numbers

# SPDX-License-Identifier: Apache-2.0
"""Names of visiting orders, in which the grid marks of a view are measured."""

from dataclasses import dataclass

from selfcal_ros.errors import InputError

ORDERS = ("raster", "serpentine", "there_and_back", "x_then_y", "x_back_y_back", "random")
"""raster: line by line along x, each line along y from its first mark to its last. serpentine:
the same, every other line backwards. there_and_back: a raster pass, then the same pass
backwards. x_then_y: a raster pass, then one that goes line by line along y. x_back_y_back: line by
line along x, back, along y, back. random: every mark once in each pass, in any order."""
PASSES = {"there_and_back": 2, "x_then_y": 2, "x_back_y_back": 4}
"""Number of passes after which an order repeats; default one."""
PLATE_SUFFIX = "@plate"
"""Suffix for lines of the plate's marks: the same marks in the same order in every view. Without
it lines are those of the stage's sites: the same sites in the same order in every view. Where the
map has nodes of its own the lines are always the plate's."""
DEFAULT_ORDER = "serpentine"
"""Order of a cell if none is specified."""


@dataclass(frozen=True)
class VisitOrder:
    """A visiting order: one of `ORDERS`, along the lines of the stage or of the plate."""

    name: str
    of_plate: bool = False

    @property
    def passes(self) -> int:
        """Passes after which it repeats: a view has as many repeats, or a multiple."""
        return PASSES.get(self.name, 1)

    def __str__(self) -> str:
        """Return the name of the order."""
        return self.name + PLATE_SUFFIX * self.of_plate


def parse_order(text: str, where: str = "visit_order") -> VisitOrder:
    """Return the order named by a text such as ``there_and_back@plate``.

    Raises
    ------
    InputError
        If no order has that name.
    """
    name = text.removesuffix(PLATE_SUFFIX)
    if name not in ORDERS:
        raise InputError(where, f"'{text}' is not a visiting order",
                         f"use one of {', '.join(ORDERS)}, if need be with {PLATE_SUFFIX}")
    return VisitOrder(name, name != text)

# SPDX-License-Identifier: Apache-2.0
"""Cells in which a plate lies otherwise than their commands say."""

from dataclasses import replace
from typing import Any

from test.support.collecting import Scene, scene
from test.support.plans import plan_of

NOISE: dict[str, Any] = {"sigma_xy_m": 2e-8, "repeats": 2, "size": 7, "count": 0}


def laid(planned: str, lies: str, *, with_ids: bool, seed: int = 3,
         **how: Any) -> tuple[Scene, list[str]]:
    """Return the messages of a cell whose plates lie otherwise than its commands say."""
    cell = scene(lies, with_ids=with_ids, seed=seed, **NOISE, **how)
    views = plan_of(planned, NOISE["size"], count=0, repeats=2).views
    cell.commands = [replace(c, view=views[c.view_index]) if c.view else c for c in cell.commands]
    return cell, [view.name for view in views]

# SPDX-License-Identifier: Apache-2.0
"""What a recheck found, in words."""

import os
from collections.abc import Mapping
from typing import Any

from selfcal_ros.errors import printable
from selfcal_ros.model.verdict import Finding
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M

STILL_GOOD = "Still good"
CHANGED = "Changed"


def recheck_sentence(found: Mapping[str, Any]) -> str:
    """Return the verdict of a recheck in one sentence.

    Parameters
    ----------
    found : mapping
        ``recheck`` of RESULT.json.
    """
    since = printable(os.path.basename(str(found["of"])))
    if found["changed"]:
        return (f"{CHANGED} since {since}: calibrate anew; {_largest(found['largest'])} "
                f"(p = {found['p']:.2g})")
    return (f"{STILL_GOOD}: no change since {since} beyond its uncertainty (p = {found['p']:.2g}); "
            f"{_largest(found['largest'])}")


def _largest(of: Mapping[str, Any]) -> str:
    at = f"x = {of['x'] * MM_PER_M:.6g}, y = {of['y'] * MM_PER_M:.6g} mm"
    return (f"most at {at}, by {of['change'] * UM_PER_M:+.3f} ± {of['u'] * UM_PER_M:.3f} µm along "
            f"{of['axis']} (k=1)")


def recheck_lines(found: Mapping[str, Any]) -> list[str]:
    """Return what a recheck found in a few lines: both maps, and the scale."""
    scale = found["scale"]
    out = [f"XY     rms {found['rms'] * UM_PER_M:.5f} µm per axis, "
           f"u {found['u_rms'] * UM_PER_M:.5f} µm, p = {found['p_xy']:.2g}"]
    if "p_theta" in found:
        line = found["largest_theta"]
        out.append(f"theta  most at line {line['line']}, by "
                   f"{line['change'] * ARCSEC_PER_RAD:+.4f} ± {line['u'] * ARCSEC_PER_RAD:.4f} "
                   f"arcsec (k=1), p = {found['p_theta']:.2g}")
    return [*out, f"scale  {scale['change'] * UM_PER_M:+.4f} ± {scale['u'] * UM_PER_M:.4f} µm/m "
            f"against the plate (k=1), p = {scale['p']:.2g}"]


def changed_text(found: Finding, of: Mapping[str, Any]) -> str:
    """Return the warning of a stage that has changed."""
    return recheck_sentence({"changed": True, "of": of["of"], "p": found.p, "largest": {
        "x": of["x"], "y": of["y"], "axis": found.axis, "change": found.size, "u": found.u}})


def misfit_text(found: Finding, _: Mapping[str, Any]) -> str:
    """Return the reason why readings do not fit a known plate."""
    return (f"residuals are {found.size:.2f} times what the noise and the known plate allow "
            f"(p = {found.p:.2g}): is it that plate, does it lie as planned, and has the map "
            "enough nodes?")

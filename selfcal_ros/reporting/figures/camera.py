# SPDX-License-Identifier: Apache-2.0
"""The camera's errors at the cells of an image, as arrows."""

import numpy as np

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.figures import drawing as draw
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.summary.camera import cells_of
from selfcal_ros.reporting.summary.format import significant
from selfcal_ros.units import MM_PER_M, UM_PER_M

LEFT, TOP, SIDE = 58.0, 40.0, 260.0


def camera_errors(result: CalibrationResult) -> draw.Drawing | None:
    """Return the camera's errors, published minus true offset, as vectors; None without images."""
    cells = cells_of(result)
    if not cells.size:
        return None
    place, error, u = cells[:2] * MM_PER_M, cells[2:4], cells[4:6] * result.noise.k_xy
    apart = abs(place[0] + 1j * place[1] - (place[0] + 1j * place[1])[:, None])
    spacing = float(apart[apart > 0].min(initial=np.inf)) if len(apart) > 1 else 1.0
    factor = parts.enlargement(np.hypot(*error), spacing / MM_PER_M)
    reach = float(np.abs(np.concatenate([place, place + error * factor * MM_PER_M])).max())
    half = max(reach, float(np.abs(place).max()) + spacing / 2) * 1.1
    drawing = parts.titled("camera", "Error of the camera, published − true offset")
    frame = draw.Frame(drawing, (LEFT, TOP, SIDE, SIDE), (-half, half), (-half, half))
    drawing.discs([frame.at(x, y) for x, y in place.T], 2.0, fill="soft")
    parts.arrows(frame, place, error, factor)
    frame.axes(x_label="offset x in mm", y_label="offset y in mm")
    for x, y, dx, dy, ux, uy in np.concatenate([place, error * UM_PER_M, u * UM_PER_M]).T:
        words = (f"{significant(dx)} ± {significant(ux)} µm, {significant(dy)} ± "
                 f"{significant(uy)} µm (k = {result.noise.k_xy:.3g})")
        drawing.spot(*frame.at(x, y), 12.0, f"x {x:.4g} mm, y {y:.4g} mm: {words}")
    parts.arrow_key(frame, factor, (LEFT, TOP + SIDE + 58))
    drawing.label(LEFT + 130, TOP + SIDE + 62, f"vectors enlarged {factor:,.0f} ×")
    drawing.height = TOP + SIDE + 76
    return drawing

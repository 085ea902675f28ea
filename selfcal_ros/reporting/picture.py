# SPDX-License-Identifier: Apache-2.0
"""Figures as pictures: laid out and drawn once.

`Figure.savefig` draws a figure that has a layout twice, the first time for its layout alone.
"""

import io
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from matplotlib.figure import Figure

CANVASES = {"png": "agg", "svg": "svg", "pdf": "pdf"}
"""Kinds of pictures, and the backend of matplotlib that draws them."""


def picture(figure: Figure, kind: str, *, dpi: float,
            metadata: Mapping[str, str | None] | None = None) -> bytes:
    """Return a figure as a picture: the bytes of its `savefig`.

    Parameters
    ----------
    figure : Figure
        What to draw; it loses its layout engine, which has done its work.
    kind : str
        One of `CANVASES`.
    dpi : float
        Pixels per inch of what is drawn in pixels.
    metadata : mapping, optional
        What is written into the file about it.
    """
    backend = import_module(f"matplotlib.backends.backend_{CANVASES[kind]}")
    canvas: Any = backend.FigureCanvas(figure)
    figure.set_dpi(dpi)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
        figure.set_dpi(dpi)  # the layout of vector formats sets it to their points
    buffer = io.BytesIO()
    getattr(canvas, f"print_{kind}")(buffer, metadata=metadata)
    return buffer.getvalue()

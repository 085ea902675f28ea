# SPDX-License-Identifier: Apache-2.0
import io

import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from selfcal_ros.reporting.picture import picture

UNDATED = {"png": {"Software": "x"}, "svg": {"Creator": "x", "Date": None},
           "pdf": {"Creator": "x", "CreationDate": None}}


class Counted(Line2D):
    """A line that counts how often it is drawn."""

    drawn = 0

    def draw(self, renderer):
        self.drawn += 1
        super().draw(renderer)


class CountedLayout(ConstrainedLayoutEngine):
    """A layout that counts how often it is made."""

    made = 0

    def execute(self, figure):
        self.made += 1
        return super().execute(figure)


def a_figure():
    figure = Figure(figsize=(2, 1), layout=CountedLayout())
    axes = figure.subplots()
    axes.imshow([[0, 1], [2, 3]])
    axes.set(xticks=[], yticks=[0, 1], ylabel="high")
    return figure, axes.add_line(Counted([0, 1], [0, 1]))


@pytest.mark.parametrize("kind", UNDATED)
def test_a_picture_is_what_savefig_writes_and_is_drawn_once(kind):
    with rc_context({"svg.hashsalt": "x"}):
        figure, line = a_figure()
        layout = figure.get_layout_engine()
        found = picture(figure, kind, dpi=37, metadata=UNDATED[kind])
        assert line.drawn == layout.made == 1
        figure, _ = a_figure()
        wanted = io.BytesIO()
        figure.savefig(wanted, format=kind, dpi=37, metadata=UNDATED[kind])
    assert found == wanted.getvalue()

# SPDX-License-Identifier: Apache-2.0
"""What the plate itself may do in each placing: patterns and findings of its blocks.

A size says how far placings scatter about what they have in common, so that each has its own; free
ones are relative to the first placing, as what all have in common is the plate's.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from selfcal_ros.blocks import Estimates, Located, Pattern, Where
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def of_each_placing(
    inputs: TermInputs,
    term: ModelTerm,
    forms: Sequence[np.ndarray],
    coefficients: Sequence[tuple[str, int, complex]],
) -> Iterator[Pattern]:
    """Yield patterns that are the same at all visits of a mark.

    Parameters
    ----------
    inputs, term : TermInputs, ModelTerm
        As for `Block.patterns`.
    forms : sequence of complex array (marks,)
        Displacement of the marks for a unit, plate frame, m.
    coefficients : sequence of (str, int, complex)
        Component, number of its form, factor.
    """
    for first, members in list(inputs.members.items())[1 if term.free else 0 :]:
        read_marks = {view: inputs.weight[view].reshape(-1) > 0 for view in members}
        of_form = [
            {view: form * read for view, read in read_marks.items()} for form in forms
        ]
        for component, number, factor in coefficients:
            yield Pattern(((component, factor),), of_form[number], view=first)


def against_first(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield the differences of the coefficients from those of the first view.

    If the term is free, the first view has no coefficients of its own: they are 0.
    """
    for column, row in zip(
        estimates.columns, np.eye(len(estimates.columns)), strict=True
    ):
        row -= [
            c.view == 0 and c.component == column.component for c in estimates.columns
        ]
        if row.any():
            where = Where(
                view=names[column.view], against=names[0], part=column.component
            )
            yield where, row

# SPDX-License-Identifier: Apache-2.0
"""The controller's evaluation of calibration tables, one position at a time, from the rules.

Written from the text alone and shares nothing with the package: explicit lists of reference
positions, searched from end to end.
"""

import itertools
import math


def per_unit(word, divisor, axis):
    """Primary units in one unit of a file; `axis` is a dict of its setup."""
    size = {
        "PRIMARY": 1.0,
        "COUNTS": 1.0 / axis.get("counts", math.nan),
        "SECONDARY": axis.get("secondary", math.nan) / axis.get("counts", math.nan),
    }
    return size[word] / divisor


def interpolate(positions, values, at):
    """Linear interpolation; the nearest end point outside."""
    pairs = sorted(zip(positions, values, strict=True))
    if at <= pairs[0][0]:
        return pairs[0][1]
    if at >= pairs[-1][0]:
        return pairs[-1][1]
    for (p0, v0), (p1, v1) in itertools.pairwise(pairs):
        if p0 <= at <= p1:
            return v0 + (v1 - v0) * (at - p0) / (p1 - p0)
    raise AssertionError("not reached")


def wrap(positions, at, rollover):
    """Position brought into the turn that starts at the lowest reference position."""
    if rollover is None:
        return at
    low = min(positions)
    return at - math.floor((at - low) / rollover) * rollover


def unit_of(unit, fallback="COUNTS"):
    return (fallback, 1.0) if unit is None else (str(unit.word), unit.divisor)


def slow_1d(table, at, axes, temperature=None):
    """Correction of one 1D table; `axes` maps axis -> dict(counts, secondary, direction, ...)."""
    reference = table.reference_axis or table.axis
    ref, out = axes[reference], axes[table.axis]
    word = unit_of(table.pos_unit)
    size = per_unit(*word, ref)
    positions = []
    for n in range(len(table.values)):
        position = (n * table.sample_dist - (table.offset or 0.0)) * size
        positions.append(-position if table.negpos else position)
    # A point of the stage keeps its place; home moves, so its coordinate moves the other way.
    if table.home_direction is not None:
        before = (table.home_offset or 0.0) + (table.full_travel or 0.0) * (
            table.home_direction == "CW"
        )
        now = ref.get("offset", table.home_offset or 0.0) + (
            table.full_travel or 0.0
        ) * (ref.get("direction", table.home_direction) == "CW")
        positions = [p + before - now for p in positions]
    if table.absolute_feedback_offset is not None and "feedback" in ref:
        move = (ref["feedback"] - table.absolute_feedback_offset) / ref["counts"]
        positions = [p + move for p in positions]
    word = unit_of(table.cor_unit, None)
    word = unit_of(table.pos_unit) if word[0] is None else word
    sign = -1 if table.negcor else 1
    values = [sign * v * per_unit(*word, out) for v in table.values]
    rollover = None if table.rollover is None else table.rollover / ref["counts"]
    correction = interpolate(
        positions, values, wrap(positions, at, rollover)
    ) - interpolate(positions, values, wrap(positions, 0.0, rollover))
    if None not in (table.expand_coeff, table.material_temp, temperature):
        correction -= at * table.expand_coeff * (temperature - table.material_temp)
    return correction, positions, rollover


def slow_2d(table, row_at, column_at, axes):
    """Corrections of one 2D or galvo table, and what is needed to know where it jumps."""
    word = unit_of(table.pos_unit)
    tracks = []
    for axis, sample, offset, roll, feedback, count in (
        (
            table.row_axis,
            table.sample_row,
            table.offset_row,
            table.rollover_row,
            table.absolute_feedback_offset_row,
            table.values.shape[0],
        ),
        (
            table.column_axis,
            table.sample_col,
            table.offset_col,
            table.rollover_col,
            table.absolute_feedback_offset_col,
            table.values.shape[1],
        ),
    ):
        setup = axes[axis]
        size = per_unit(*word, setup)
        if table.galvo:
            positions = [(n - (count - 1) / 2) * sample * size for n in range(count)]
        else:
            positions = [(n * sample - (offset or 0.0)) * size for n in range(count)]
        if feedback is not None and "feedback" in setup:
            positions = [
                p + (setup["feedback"] - feedback) / setup["counts"] for p in positions
            ]
        tracks.append((positions, None if roll is None else roll / setup["counts"]))
    (rows, row_roll), (columns, column_roll) = tracks
    slack = [
        1e-9 * abs(sample * per_unit(*word, axes[axis]))
        for sample, axis in (
            (table.sample_row, table.row_axis),
            (table.sample_col, table.column_axis),
        )
    ]
    zeros = [wrap(p, 0.0, r) for p, r in tracks]
    inside = all(
        min(p) - s <= z <= max(p) + s
        for (p, _), z, s in zip(tracks, zeros, slack, strict=True)
    )
    sign = -1 if table.negcor else 1
    corrections = []
    for number, output in enumerate(table.output_axes):
        size = sign * per_unit(*unit_of(table.cor_unit), axes[output])

        def at(row, column, number=number, size=size):
            along = [
                interpolate(columns, [v * size for v in line[:, number]], column)
                for line in table.values
            ]
            return interpolate(rows, along, row)

        value = at(wrap(rows, row_at, row_roll), wrap(columns, column_at, column_roll))
        corrections.append(value - (at(*zeros) if inside else 0.0))
    return corrections, tracks

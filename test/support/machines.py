# SPDX-License-Identifier: Apache-2.0
"""Stages with controllers that read the text of their tables by themselves, from the documents.

Nothing of the package is used. A table is a function of positions px, py (P,) of the controller,
in its unit, to what is added to both, (P, 2).
"""

import re
from collections.abc import Callable

import numpy as np

Table = Callable[[np.ndarray, np.ndarray], np.ndarray]


def weights(nodes, at, edge="hold"):
    """Return the shares of ascending nodes in linear interpolation at positions, (P, nodes)."""
    at = np.asarray(at, dtype=float)
    if edge == "roll":
        at = nodes[0] + (at - nodes[0]) % (nodes[-1] - nodes[0])
    below = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    part = (at - nodes[below]) / (nodes[below + 1] - nodes[below])
    part = np.clip(part, 0, 1) if edge == "hold" else part
    out, row = np.zeros((len(at), len(nodes))), np.arange(len(at))
    out[row, below], out[row, below + 1] = 1 - part, part
    return out


def plane(x, y, values, edge="hold"):
    """Return the function that is bilinear between values at y (rows) and x (columns)."""
    return lambda px, py: np.einsum(
        "pr,pc,rc->p", weights(y, py, edge), weights(x, px, edge), values
    )


def numbers_in(line):
    return [
        float(word) for word in re.findall(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?", line, re.I)
    ]


def cal(texts, _counts):
    """Aerotech: one 2D table of positions in primary units, zero at home."""
    lines = [line for line in texts[0].splitlines() if line and line[0] not in ";"]
    row, column, *outputs, down, across, width = map(float, lines[0].split()[1:])
    offset = {
        m[1]: float(m[2])
        for line in lines
        if (m := re.fullmatch(r":START2D OFFSET(ROW|COL)=(\S+)", line))
    }
    assert ":START2D POSUNIT=PRIMARY" in lines
    [um] = [
        float(m[1] or 1)
        for line in lines
        if (m := re.fullmatch(r":START2D CORUNIT=PRIMARY(?:/(\S+))?", line))
    ]
    values = np.array([line.split() for line in lines if line[0] != ":"], dtype=float)
    values = values.reshape(len(values), -1, 2) / um
    assert values.shape[1] == width and outputs == [column, row]
    x, y = (
        across * np.arange(width) - offset["COL"],
        down * np.arange(len(values)) - offset["ROW"],
    )
    if across < 0:
        x, values = x[::-1], values[:, ::-1]
    if down < 0:
        y, values = y[::-1], values[::-1]
    fields = [plane(x, y, values[:, :, axis]) for axis in (0, 1)]

    def add(px, py):
        return np.stack(
            [f(px, py) - f(np.zeros(1), np.zeros(1)) for f in fields], axis=-1
        )

    return add


def kmotion(texts, _counts):
    """KMotion: absolute positions to command; rows along y; the edge cell extrapolates."""
    lines = [numbers_in(line) for line in texts[0].splitlines()]
    rows, columns = map(int, lines[0])
    (dx, dy), (x0, y0) = lines[1:3]
    commands = np.full((rows, columns, 2), np.nan)
    for row, column, *command in lines[3 : 3 + rows * columns]:
        commands[int(row), int(column)] = command[:2]
    x, y = x0 + dx * np.arange(columns), y0 + dy * np.arange(rows)
    fields = [plane(x, y, commands[:, :, axis], "extrapolate") for axis in (0, 1)]
    return lambda px, py: np.stack(
        [fields[0](px, py) - px, fields[1](px, py) - py], axis=-1
    )


def pmac(texts, counts):
    """Turbo PMAC: motors 1 and 2, or the two of the table, x first; sixteenths of a count."""
    lines = [re.sub(";.*", "", line).strip() for line in texts[0].splitlines()]
    fields, order = {}, []
    for at, line in enumerate(lines):
        match = re.fullmatch(
            r"DEFINE COMP (\d+)\.(\d+),#(\d+)D,#(\d+)D,#(\d+),(\d+),(\d+)", line
        )
        if not match:
            continue
        rows, columns, row_motor, column_motor, target, row_span, column_span = map(
            int, match.groups()
        )
        found = [0.0]
        for more in lines[at + 1 :]:
            if not re.fullmatch(r"[-\d ]+", more):
                break
            found += map(float, more.split())
        order = [row_motor, column_motor]
        fields[target] = plane(
            np.linspace(0, row_span, columns + 1),
            np.linspace(0, column_span, rows + 1),
            np.reshape(found, (rows + 1, columns + 1)) / 16,
            "roll",
        )
    return lambda px, py: np.stack(
        [
            fields[motor](px * counts[0], py * counts[1]) / per
            for motor, per in zip(order, counts, strict=True)
        ],
        axis=-1,
    )


def beckhoff(texts, _counts, unit_m=1e-3, subtract=False):
    """Beckhoff: the lists of the slaves x and y, in 0.1 um; masters x, then y."""
    fields, per = [], unit_m / 1e-7
    for text in texts:
        found = dict(re.findall(r"^kw\.crosscomp2\.(\w+) (\S+)$", text, re.M))
        step = float(found["interval"])
        x, y = (
            float(found[f"start_position_master{n}"])
            + step * np.arange(int(found[f"last_index_master{n}"]) + 1)
            for n in (1, 2)
        )
        values = np.full((len(y), len(x)), np.nan)
        for j, i, value in re.findall(
            r"table\[(\d+)\]\[(\d+)\]\.correction (\S+)", text
        ):
            values[int(j), int(i)] = float(value)
        fields.append(plane(x, y, values))
    sense = (-1 if subtract else 1) / per
    return lambda px, py: (
        sense * np.stack([f(px * per, py * per) for f in fields], axis=-1)
    )


def linuxcnc(texts, _counts):
    """LinuxCNC: nominal - forward is added to each joint."""
    joints = []
    for text in texts:
        lines = text.split("\n\n")[0].splitlines()
        joints.append(np.array([line.split() for line in lines], dtype=float).T)
    return lambda px, py: np.stack(
        [
            np.interp(p, nominal, nominal - forward)
            for p, (nominal, forward, _) in zip((px, py), joints, strict=True)
        ],
        axis=-1,
    )


def siemens(texts, _counts, subtract=False):
    """Siemens: the sum of CEC tables of the axes that the first one names x and y, lowest first."""
    [text] = texts
    tables = sorted(set(re.findall(r"^\$AN_CEC\[(\d),", text, re.M)))
    found = []
    for table in tables:
        get = dict(re.findall(rf"^\$AN_CEC_(\w+)\[{table}\]=(\S+)$", text, re.M))
        values = [
            float(v)
            for _, v in sorted(
                (int(n), v)
                for n, v in re.findall(
                    rf"^\$AN_CEC\[{table},(\d+)\]=(\S+)$", text, re.M
                )
            )
        ]
        at = float(get["MIN"]) + float(get["STEP"]) * np.arange(len(values))
        assert abs(at[-1] - float(get["MAX"])) < 1e-6
        found.append((get["INPUT_AXIS"], get["OUTPUT_AXIS"], at, values))
    names = [found[0][0], found[1][0]]

    def add(px, py):
        out = np.zeros((len(px), 2))
        for source, target, at, values in found:
            out[:, names.index(target)] += np.interp(
                (px, py)[names.index(source)], at, values
            )
        return -out if subtract else out

    return add


READERS = {
    "cal": cal,
    "kmotion": kmotion,
    "pmac": pmac,
    "beckhoff": beckhoff,
    "linuxcnc": linuxcnc,
    "siemens": siemens,
}


class Machine:
    """A stage with an error, and a controller whose x and y have these homes and directions.

    Parameters
    ----------
    nodes : list of float array
        Positions x and y of the nodes of the error, m.
    error : float array (2, nx, ny)
        G = indicated - true, m, bilinear. It is taken to be zero at home.
    home, sign : tuple
        Home in the stage frame, m; direction of the encoders.
    unit_m : float
        Unit of the controller.
    """

    def __init__(self, nodes, error, home=(0.0, 0.0), sign=(1, 1), unit_m=1e-3):
        self.nodes, self._error = nodes, error
        self.home, self.sign, self.unit_m = np.array(home), np.array(sign), unit_m
        self._at_home = self._field(self.home[None])

    def _field(self, true):
        shares = [weights(at, p) for at, p in zip(self.nodes, true.T, strict=True)]
        return np.einsum("px,py,kxy->pk", *shares, self._error)

    def error(self, true):
        """Return G at true positions (P, 2), m."""
        return self._field(true) - self._at_home

    def shown(self, true, table):
        """Return what the controller shows while the stage is at true positions (P, 2), m."""
        encoder = self.sign * (true + self.error(true) - self.home) / self.unit_m
        command = encoder
        for _ in range(12):
            command = encoder - table(*command.T)
        return self.sign * command * self.unit_m + self.home

    def reached(self, wanted, table, sense=1):
        """Return where the stage goes when positions (P, 2) are commanded, m."""
        command = self.sign * (wanted - self.home) / self.unit_m
        encoder = (
            self.sign * (command + sense * table(*command.T)) * self.unit_m + self.home
        )
        true = encoder
        for _ in range(12):
            true = encoder - self.error(true)
        return true

    def off(self, table, *, between=False, sense=1):
        """Return the largest residual at the nodes, or within cells, without the common shift."""
        x, y = (
            np.sort(
                np.concatenate(
                    [at[:-1] + 0.3 * np.diff(at), at[:-1] + 0.8 * np.diff(at)]
                )
            )
            if between
            else at
            for at in self.nodes
        )
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        found = self.reached(points, table, sense) - points
        return float(np.abs(found - found.mean(axis=0)).max())

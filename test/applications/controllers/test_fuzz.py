# SPDX-License-Identifier: Apache-2.0
"""Damaged tables: each is read as it stands, or refused in one line."""

import random

import numpy as np
import pytest

from selfcal_ros.applications.controllers.export import FORMATS, loaded
from selfcal_ros.applications.controllers.grid import Source
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.applications.controllers.test_export import FRAMES, wiring_of
from test.support.maps import random_map

ODD = (
    "",
    "nan",
    "1e999",
    "-1",
    "0",
    "99999999999999999999",
    "x",
    "µ",
    ",",
    ";",
    "#",
    "/*",
    "[",
    "0x10",
    "1.5",
    "\0",
    "--3",
    " ",
    "3 3",
    "1e-400",
    "4001",
)


def damaged(text: str, rng: random.Random) -> str:
    lines = text.split("\n")
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(lines))
        kind = rng.randrange(6)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines.insert(at, lines[rng.randrange(len(lines))])
        elif kind == 2:
            lines = lines[:at]
        elif kind == 3:
            words = lines[at].replace(",", " , ").replace("=", " = ").split(" ")
            words[rng.randrange(len(words))] = rng.choice(ODD)
            lines[at] = "".join(words) if rng.random() < 0.5 else " ".join(words)
        else:
            place = rng.randrange(len(lines[at]) + 1)
            lines[at] = (
                lines[at][:place]
                + rng.choice([*ODD, chr(rng.randrange(1, 300))])
                + lines[at][place + rng.randrange(3) :]
            )
        lines = lines or [""]
    return "\n".join(lines)


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused_in_one_line(name):
    wiring, rng = wiring_of(FRAMES[0], name), random.Random(1)
    texts = [
        "\n".join(lines)
        for lines in FORMATS[name]
        .write(random_map(Artifact(3, 0.01), 1), wiring)
        .values()
    ]
    at, refused = np.linspace(-15.0, 15.0, 7), 0
    for _ in range(600):
        spoilt = rng.randrange(len(texts))
        sources = [
            Source(damaged(text, rng) if n == spoilt else text, "file")
            for n, text in enumerate(texts)
        ]
        try:
            found = loaded(name, sources, wiring)(at, at[::-1])
        except InputError as error:
            assert "\n" not in str(error) and str(error).startswith("file")
            refused += 1
        else:
            assert all(np.isfinite(c).all() and c.shape == at.shape for c in found)
    assert 200 < refused < 600


@pytest.mark.parametrize("name", FORMATS)
def test_an_empty_file_and_the_wrong_number_of_files_are_refused(name):
    wiring, parts = wiring_of(FRAMES[0], name), FORMATS[name].parts
    with pytest.raises(InputError):
        loaded(name, [Source("", "file")] * len(parts), wiring)
    with pytest.raises(InputError, match=f"--onto: 3 files; {name} has {len(parts)}: "):
        loaded(name, [Source("", "file")] * 3, wiring)

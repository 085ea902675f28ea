# SPDX-License-Identifier: Apache-2.0
"""Cut and damaged bags: what is there is read, what was lost is said, never a traceback."""

from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError

SOURCE = Path(__file__).parents[2] / "bags" / "hu_exact" / "hu_exact_0.mcap"
DATA = SOURCE.read_bytes()
TOTAL = 2244 + 448 + 9


def read(path):
    reader = BagReader(path)
    return sum(1 for _ in reader.messages()), reader.lost


def test_a_later_cut_never_reads_less_and_every_loss_is_said(tmp_path):
    counts = []
    for size in np.linspace(200, len(DATA) - 40, 40).astype(int):
        file = tmp_path / "cut.mcap"
        file.write_bytes(DATA[:size])
        count, lost = read(file)
        assert len(lost) == 1 and (str(size) in lost[0] or "no message is lost" in lost[0]
                                   or "without its footer" in lost[0])
        counts.append(count)
    assert counts == sorted(counts)
    assert counts[0] < TOTAL / 10 and counts[-1] == TOTAL
    assert len(set(counts)) > 3, "the front part of a chunk that was cut off is read as well"


@pytest.mark.parametrize("seed", range(40))
def test_flipped_bytes_end_in_a_result_or_in_one_line(tmp_path, capsys, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(DATA)
    for at in rng.integers(8, len(data), 3):
        data[at] ^= int(rng.integers(1, 256))
    file = tmp_path / "bad.mcap"
    file.write_bytes(data)
    code = main(["solve", str(file), "--quiet"])
    err = capsys.readouterr().err
    assert code in (0, 2, 3, 4)
    assert code == 0 or err.strip()
    assert "Traceback" not in err


def test_a_truncated_bag_gives_the_result_of_what_is_there(tmp_path, capsys):
    file = tmp_path / "cut.mcap"
    file.write_bytes(DATA[:int(len(DATA) * 0.35)])
    assert main(["solve", str(file), "--quiet"]) in (3, 4)
    assert "truncated" in capsys.readouterr().err
    count, lost = read(file)
    assert 0 < count < TOTAL and "could be saved" in lost[0]


def test_what_is_no_bag_is_refused(tmp_path):
    for content, message in ((b"", "the file is empty"), (b"hello world", "not an MCAP file")):
        file = tmp_path / "x.mcap"
        file.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read(file)

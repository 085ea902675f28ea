# SPDX-License-Identifier: Apache-2.0
"""`make chaos`: cells whose messages are lost, doubled and late, and whose nodes are killed.

In each round, of its own seed, two cells run side by side, then one whose disk is full for a while,
one whose sequencers are killed, one in which a run was stamped a day ahead before, and one among
strangers who would harm: see `test.support.chaos`.

    make chaos [ROUNDS=10] [SEED=1]
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from selfcal_ros.cli.processes import domain
from test.support.chaos import (
    attacked,
    clock_ahead,
    full_disk,
    killed_sequencers,
    one_round,
)


def main() -> int:
    """Run the rounds in a ROS domain of their own; 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1, help="of the first round")
    args = parser.parse_args()
    bad = 0
    with domain() as environment, tempfile.TemporaryDirectory() as folder:
        os.environ.update(environment)
        for seed in range(args.seed, args.seed + args.rounds):
            place = Path(folder, str(seed))
            place.mkdir()
            lines, wrong = one_round(seed, environment, place)
            for other in (full_disk, killed_sequencers, clock_ahead, attacked):
                line, faults = other(seed, environment, place)
                lines.append(f"{other.__name__}: {line}")
                wrong += [f"{other.__name__}: {fault}" for fault in faults]
            bad += bool(wrong)
            print(
                f"round {seed}: " + ("WRONG" if wrong else "right"),
                *lines,
                *wrong,
                sep="\n  ",
                flush=True,
            )
            shutil.rmtree(place)
    print(f"{args.rounds - bad} of {args.rounds} rounds right")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

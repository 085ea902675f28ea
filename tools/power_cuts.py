# SPDX-License-Identifier: Apache-2.0
"""`make power-cuts`: `selfcal measure` killed with SIGKILL at seeded points, and resumed.

A run on the simulated machine is killed in and between moves, in exposures, with half of a message
written, before a file is on the disk and before it has its name; the same command with --resume
goes on. The map equals that of an undisturbed run if no detection of the bag is lost or doubled, it
is qualified as well, and at each node both differ by no more than 4 standard uncertainties of the
difference.

    make power-cuts [CUTS=20] [SEED=1]
"""

import argparse
import signal
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from selfcal_ros.units import NM_PER_M
from test.support.power_cuts import (
    cuts,
    detections,
    measured,
    outcome,
    passages,
    prepare,
)

SIGMAS = 4.0


def main() -> int:
    """Print a table of all cuts; 1 if one is not resumed to the same map."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder, "whole")
        prepare(whole)
        undisturbed = measured(whole)
        if undisturbed.returncode:
            sys.exit(undisturbed.stderr)
        print(
            f"{'killed':32} {'at':>5} {'kept':>5} {'lost':>5} {'twice':>5} {'away nm':>8} "
            f"{'/ u':>5}"
        )
        wrong = 0
        for number, cut in enumerate(cuts(args.cuts, args.seed, passages(whole))):
            place = Path(folder, str(number))
            prepare(place)
            killed = measured(place, cut)
            kept = detections(place)
            resumed = measured(place)
            head = f"{cut.point:32} {cut.number:5} {len(kept):5}"
            if killed.returncode != -signal.SIGKILL or resumed.returncode:
                wrong += 1
                print(
                    f"{head} WRONG: {killed.returncode}, {resumed.returncode}: "
                    f"{resumed.stderr.strip().splitlines()[-1:]}",
                    flush=True,
                )
                continue
            found = outcome(place, whole, kept)
            is_right = (
                not found.lost
                and not found.doubled
                and found.qualified
                and (found.away <= SIGMAS)
            )
            wrong += not is_right
            print(
                f"{head} {found.lost:5} {found.doubled:5} {found.away_m * NM_PER_M:8.3f} "
                f"{found.away:5.2f}{'' if is_right else '  WRONG'}",
                flush=True,
            )
    print(
        f"{args.cuts - wrong} of {args.cuts} resumed to the map of the undisturbed run"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

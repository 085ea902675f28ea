# SPDX-License-Identifier: Apache-2.0
"""Entry points of all commands. An interrupt while modules are imported waits until they are.

Python would end in the middle of an import with a traceback. Blocked, Ctrl-C is kept by the
system until `cli.main.main` or `nodes.running.run` let it through to where it is handled.
"""

import importlib
import signal
from functools import partial


def _run(module: str) -> int | None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return importlib.import_module(module).main()


selfcal = partial(_run, "selfcal_ros.cli.main")
measurement_collector, pose_sequencer, solver, compensator, bag_player, bag_recorder, \
    stage_simulator = (partial(_run, f"selfcal_ros.nodes.{name}") for name in (
        "measurement_collector", "pose_sequencer", "solver", "compensator", "bag_player",
        "bag_recorder", "stage_simulator"))

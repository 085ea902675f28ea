# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: a node that cannot start ends the launch, with the reason."""

from typing import Any

from launch.actions import LogInfo, Shutdown

from selfcal_ros.errors import ExitCode


def end_if_it_cannot_start(event: Any, _context: Any) -> list[Any]:
    """Return the actions after a node's exit: shutdown, if it was for bad parameters or input.

    A node that ends later, or by a signal, ends alone: it can be started again beside the others.

    Parameters
    ----------
    event : launch.events.process.ProcessExited
        The exit.
    _context : launch.LaunchContext
        Not needed.
    """
    if event.returncode != int(ExitCode.BAD_INPUT):
        return []
    reason = f"{event.process_name} cannot start; its last line above says why"
    return [LogInfo(msg=reason), Shutdown(reason=reason)]

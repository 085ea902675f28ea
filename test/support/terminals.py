# SPDX-License-Identifier: Apache-2.0
"""Commands in a terminal of their own: what a person sees, and not what a pipe gets."""

import os
import pty
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

SELFCAL = (
    sys.executable,
    "-c",
    "import sys; from selfcal_ros.start import selfcal; sys.exit(selfcal())",
)


def in_terminal(
    command: Sequence[str],
    *,
    columns: int = 80,
    folder: Path | None = None,
    keys: bytes = b"",
) -> tuple[int, str]:
    """Run a command in a terminal; return its exit code and its output.

    `keys` are pressed when it has drawn something for the first time.
    """
    here, there = pty.openpty()
    with subprocess.Popen(
        command,
        stdin=there,
        stdout=there,
        stderr=there,
        cwd=folder,
        start_new_session=True,
        env=os.environ | {"COLUMNS": str(columns), "TERM": "xterm"},
    ) as process:
        os.close(there)
        shown = b""
        while True:
            try:
                shown += os.read(here, 4096)
                if keys:
                    os.write(here, keys)
                    keys = b""
            except OSError:  # the command has ended
                break
    os.close(here)
    return process.returncode, shown.decode(errors="replace")

# SPDX-License-Identifier: Apache-2.0
"""Install what an editable install leaves out: share files, and lib/selfcal_ros/<node>.

They let `ros2 run` and `ros2 launch` find the package in an environment without colcon.
"""

import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path


def main(prefix: Path) -> None:
    shutil.rmtree(prefix / "share" / "selfcal_ros", ignore_errors=True)
    subprocess.run(
        [
            sys.executable,
            "setup.py",
            "--quiet",
            "install_data",
            f"--install-dir={prefix}",
        ],
        check=True,
    )
    scripts = prefix / "lib" / "selfcal_ros"
    shutil.rmtree(scripts, ignore_errors=True)
    scripts.mkdir(parents=True)
    for entry in distribution("selfcal_ros").entry_points:
        if entry.group == "console_scripts":
            (scripts / entry.name).symlink_to(prefix / "bin" / entry.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

# SPDX-License-Identifier: Apache-2.0
"""Replace the paths of the machine that built the ROS wheels by this environment's own.

The wheels' CMake files name the include and site-packages folders of their build machine.
"""

import re
import sys
import sysconfig
from pathlib import Path

BUILD_MACHINE = re.compile(
    r"/opt/python/cp3\d+-cp3\d+/(include/python3\.\d+|lib/python3\.\d+/"
    r"site-packages)"
)


def main() -> None:
    own = {
        "include": sysconfig.get_path("include"),
        "lib": sysconfig.get_path("purelib"),
    }
    mended = 0
    for path in Path(sys.prefix, "share").rglob("*.cmake"):
        text = path.read_text()
        new = BUILD_MACHINE.sub(lambda match: own[match[1].split("/")[0]], text)
        if new != text:
            path.write_text(new)
            mended += 1
    print(f"{mended} CMake files mended")


if __name__ == "__main__":
    main()

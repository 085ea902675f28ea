# SPDX-License-Identifier: Apache-2.0
"""package.xml: every key exists, everything imported is declared, commands build all of it."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from selfcal_ros.start import BUILD, NEEDED
from test.support.sources import SOURCES, source

ROOT = Path(__file__).parents[2]
MANIFESTS = [ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"]
README = (ROOT / "README.md").read_text()


def known() -> dict[str, set[str]]:
    """Return what resolves a key (apt, pip, jazzy) -> the keys of known_keys.txt."""
    found: dict[str, set[str]] = {}
    for line in (Path(__file__).parent / "known_keys.txt").read_text().splitlines():
        if line.startswith("["):
            found[line[1:-1]] = keys = set()
        elif not line.startswith("#"):
            keys.add(line)
    return found


def declared(path: Path) -> set[str]:
    return {
        str(child.text)
        for child in ElementTree.parse(path).getroot()
        if child.tag.endswith("depend")
    }


def test_every_key_exists_and_none_is_kept_in_vain():
    own = {str(ElementTree.parse(path).findtext("name")) for path in MANIFESTS}
    wanted = set().union(*map(declared, MANIFESTS)) - own
    assert wanted == set().union(*known().values())


def test_ros_packages_that_are_imported_are_declared():
    used = set()
    for path in SOURCES:
        for node in (*source(path).imports, *source(path).late):
            names = (
                [alias.name for alias in node.names] if hasattr(node, "names") else []
            )
            used |= {(getattr(node, "module", None) or names[0]).split(".")[0]}
    ros = {
        name
        for name in used
        if re.fullmatch(
            r"\w+_(msgs|interfaces|srvs|index_python)|rclpy|launch\w*", name
        )
    }
    assert len(ros) > 8
    assert ros <= declared(MANIFESTS[0])


@pytest.mark.parametrize("page", ["README.md", "docker/Dockerfile"])
def test_the_commands_install_and_build_both_packages(page):
    text = (ROOT / page).read_text().replace("\\\n", " ")
    [rosdep] = re.findall(r"PIP_BREAK_SYSTEM_PACKAGES=1 rosdep install[^\n&]*", text)
    assert {"src/selfcal_ros", "src/selfcal_ros/msg_defs", "--ignore-src"} <= set(
        rosdep.split()
    )
    assert known()["pip"], "else nothing has to break system packages"
    assert " ".join(BUILD.split()) in " ".join(text.split())
    assert "apt install" in text or "apt-get install" in text
    assert (
        "python3-threadpoolctl" in text
        and "python3-threadpoolctl" in NEEDED["threadpoolctl"]
    )


def test_the_container_copies_what_exists_and_all_that_is_installed():
    text = (ROOT / "docker/Dockerfile").read_text()
    copied: set[str] = set()
    for line in re.findall(r"^COPY (.+)$", text, re.M):
        *sources, target = line.split()
        assert target.startswith(("src/selfcal_ros/", "/entrypoint.sh"))
        copied |= set(sources)
    for name in copied:
        assert (ROOT / name).exists(), name
    assert {
        "package.xml",
        "setup.py",
        "setup.cfg",
        "selfcal_ros",
        "msg_defs",
        *re.findall(r'share\("(\w+)"\)', (ROOT / "setup.py").read_text()),
    } <= copied
    entry = ROOT / "docker/entrypoint.sh"
    assert entry.stat().st_mode & 0o111
    assert "source /ws/install/setup.bash" in entry.read_text()
    assert "WORKDIR /ws\n" in text and 'ENTRYPOINT ["/entrypoint.sh"]' in text
    launch = re.search(r'^CMD \["ros2", "launch", "selfcal_ros", "(.+)"\]$', text, re.M)
    assert launch is not None and (ROOT / "launch" / launch[1]).is_file()

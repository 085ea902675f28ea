# SPDX-License-Identifier: Apache-2.0
"""What is handed on: source archive and wheel, pins with hashes, bill of materials."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from selfcal_ros import __version__
from selfcal_ros.files import read_json
from tools.sbom import bill, pins

ROOT = Path(__file__).parents[2]
SOURCES = (
    "package.xml",
    "setup.py",
    "setup.cfg",
    "pyproject.toml",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "msg_defs",
    "resource",
    "config",
    "launch",
    "selfcal_ros",
)


def run(folder: Path, *words: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        check=False,
        text=True,
        capture_output=True,
        env=os.environ | environment,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel that is built from the source archive, not from the clone."""
    clone = tmp_path_factory.mktemp("clone")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, clone / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        else:
            shutil.copy(ROOT / name, clone / name)
    run(clone, "setup.py", "-q", "sdist", "-d", "dist")
    [archive] = (clone / "dist").iterdir()
    with tarfile.open(archive) as file:
        file.extractall(clone / "unpacked", filter="data")
    [source] = (clone / "unpacked").iterdir()
    for path in (ROOT / "msg_defs").rglob("*.*"):
        assert (source / path.relative_to(ROOT)).is_file(), path
    run(
        source,
        "-m",
        "pip",
        "-q",
        "--disable-pip-version-check",
        "wheel",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "-w",
        str(clone / "wheel"),
        ".",
    )
    [built] = (clone / "wheel").iterdir()
    return built


def test_the_wheel_holds_every_module_message_and_configuration(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
    for folder, pattern, place in (
        ("selfcal_ros", "*.py", "selfcal_ros/"),
        ("msg_defs/msg", "*.msg", "selfcal_ros/msg_text/"),
        ("config", "*.*", "share/selfcal_ros/config/"),
        ("launch", "*.py", "share/selfcal_ros/launch/"),
    ):
        for path in (ROOT / folder).rglob(pattern):
            end = f"{place}{path.relative_to(ROOT / folder)}"
            assert any(name == end or name.endswith(f"/{end}") for name in names), end
    assert not [name for name in names if name.startswith(("test", "tools", "bags"))]


def test_the_wheel_describes_itself(wheel):
    """One version; what it needs, and no tool of its building; README; types."""
    with zipfile.ZipFile(wheel) as file:
        [place] = (
            name for name in file.namelist() if name.endswith(".dist-info/METADATA")
        )
        about = message_from_bytes(file.read(place))
        assert "selfcal_ros/py.typed" in file.namelist()
    assert about["Version"] == __version__ == "0.4.0"
    needs = {re.match(r"[\w-]+", text)[0] for text in about.get_all("Requires-Dist")}
    assert "numpy" in needs and "setuptools" not in needs
    assert about["Description-Content-Type"] == "text/markdown"
    assert (
        about.get_payload() == (ROOT / "README.md").read_text()
        or about.get_payload(decode=True).decode().strip()
        == (ROOT / "README.md").read_text().strip()
    )
    assert "Programming Language :: Python :: 3.13" in about.get_all("Classifier")
    assert about.get_all("Project-URL")


def test_the_wheel_solves_a_bag_without_the_clone(wheel, tmp_path):
    run(
        tmp_path,
        "-m",
        "pip",
        "-q",
        "--disable-pip-version-check",
        "install",
        "--no-deps",
        "--no-index",
        "--no-compile",
        "--target",
        str(tmp_path / "site"),
        str(wheel),
    )
    place = {"PYTHONPATH": str(tmp_path / "site")}
    assert run(
        tmp_path, "-c", "import selfcal_ros; print(selfcal_ros.__file__)", **place
    ).startswith(str(tmp_path))
    run(
        tmp_path,
        "-m",
        "selfcal_ros",
        "solve",
        str(ROOT / "bags/hu_noise"),
        "-o",
        "R.json",
        "--report",
        "R.html",
        **place,
    )
    assert read_json(tmp_path / "R.json")["verdict"]["qualified"]
    assert (tmp_path / "R.html").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["requirements.txt", "oldest.txt"])
def test_every_pin_has_the_hashes_of_its_files(name):
    """pip refuses what has another hash, and a list in which one has none."""
    lines = [
        line
        for line in (ROOT / "tools" / name).read_text().splitlines()
        if not line.startswith("#")
    ]
    assert len(lines) > 20
    for line in lines:
        assert re.fullmatch(
            r"[a-z0-9.-]+==\S+( --hash=sha256:[0-9a-f]{64}){1,2}", line
        ), line
    assert "--require-hashes" in (ROOT / "tools/setup.sh").read_text()


@pytest.mark.parametrize(
    "name", ["a'b", 'a"b', "a$b", "a=b", "a,b", "a;b", "a:b", "a\\b"]
)
def test_a_folder_that_the_tools_of_ros_cannot_take_is_named_first(tmp_path, name):
    """It ended in errors of CMake after half a minute."""
    setup = tmp_path / name / "tools" / "setup.sh"
    setup.parent.mkdir(parents=True)
    shutil.copy(ROOT / "tools" / "setup.sh", setup)
    done = subprocess.run([setup], capture_output=True, text=True)
    assert done.returncode == 2 and "move the clone" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and not done.stdout


def components() -> list[dict]:
    return read_json(ROOT / "sbom.json")["components"]


def test_the_bill_of_materials_lists_what_is_pinned():
    assert {
        part["name"]: (
            part["version"],
            [digest["content"] for digest in part["hashes"]],
        )
        for part in components()
    } == pins()


def installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


@pytest.mark.skipif(
    any(installed(name) != pinned for name, (pinned, _) in pins().items()),
    reason="not the environment of `make setup`",
)
def test_the_bill_of_materials_is_current():
    assert read_json(ROOT / "sbom.json") == bill(), "run `make sbom`"


def test_no_library_of_the_product_is_under_the_gpl():
    licences = {
        part["name"]: part["licenses"][0]["expression"]
        for part in components()
        if part["scope"] != "excluded"
    }
    assert {
        "numpy",
        "scipy",
        "rosbags",
        "mcap",
        "matplotlib",
        "threadpoolctl",
        "ros-rclpy",
    } <= set(licences)
    for name, licence in licences.items():
        assert licence, name
        assert re.fullmatch(r"[\w.-]+( (AND|OR) [\w.-]+)*", licence), (
            f"{name}: not SPDX's"
        )
        assert not re.search(r"GPL|General Public", licence), f"{name}: {licence}"

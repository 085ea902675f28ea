# SPDX-License-Identifier: Apache-2.0
import runpy
from pathlib import Path

from setuptools import find_packages, setup

NAME = "selfcal_ros"
NODES = (
    "measurement_collector",
    "pose_sequencer",
    "solver",
    "compensator",
    "mark_detector",
    "bag_player",
    "bag_recorder",
    "cell_driver",
    "stage_simulator",
)


HOME = "https://selfcal-ros.example"
VERBS = runpy.run_path(str(Path(NAME, "cli", "verbs.py")))


def share(folder: str) -> list[tuple[str, list[str]]]:
    """Return the data files below a folder, one entry a folder, under share/selfcal_ros."""
    folders = sorted(
        {path.parent for path in Path(folder).rglob("*") if path.is_file()}
    )
    return [
        (
            f"share/{NAME}/{place}",
            sorted(str(p) for p in place.iterdir() if p.is_file()),
        )
        for place in folders
    ]


setup(
    name=NAME,
    version=runpy.run_path(str(Path(NAME, "__init__.py")))["__version__"],
    # the message definitions go along, so that bags can be read and written without ROS
    packages=[*find_packages(include=[NAME, f"{NAME}.*"]), f"{NAME}.msg_text"],
    package_dir={f"{NAME}.msg_text": "msg_defs/msg"},
    package_data={
        f"{NAME}.msg_text": ["*.msg"],
        f"{NAME}.reporting": ["assets/*.js"],
        NAME: ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *share("launch"),
        *share("config"),
    ],
    # at least what Ubuntu 24.04 has (`make test-oldest`); what it has not comes from PyPI
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "pyyaml",
        "mcap>=1.1",
        "rosbags>=0.10",
        "matplotlib>=3.6",
        "rich>=13",
        "argcomplete>=3",
        "threadpoolctl>=3",
        "pillow>=10",
        "lz4",
        "zstandard",
    ],
    extras_require={
        "test": ["pytest>=7.4", "hypothesis>=6.98"],  # colcon looks for pytest here
        "dask": ["distributed>=2024.1"],
        "gcode": ["pyserial>=3.5"],  # BSD
        "camera": ["opencv-python-headless>=4.8"],  # Apache-2.0
        "ophyd": ["ophyd>=1.9"],  # BSD
        "micromanager": ["pymmcore>=11.1"],  # LGPL: loaded, never shipped
        "pdf": ["weasyprint>=62"],
        "plate": ["ezdxf>=1.3", "gdstk>=0.9"],
    },
    python_requires=">=3.12",
    zip_safe=False,
    maintainer="selfcal_ros maintainers",
    maintainer_email="maintainers@selfcal-ros.example",
    description="Self-calibration of precision XY-theta stages in the machine, "
    "without a better standard.",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    url=HOME,
    project_urls={
        "Documentation": f"{HOME}/docs",
        "Source": f"{HOME}/source",
        "Changelog": f"{HOME}/changelog",
    },
    keywords=[
        "calibration",
        "self-calibration",
        "metrology",
        "uncertainty",
        "ROS 2",
        "stage",
    ],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Environment :: Console",
        "Intended Audience :: Manufacturing",
        "Intended Audience :: Science/Research",
        "Operating System :: OS Independent",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "selfcal = selfcal_ros.start:selfcal",
            *(f"{node} = {NAME}.start:{node}" for node in NODES),
        ],
        VERBS["ENTRY_POINTS"]: [
            f"{verb} = {VERBS['module_of'](verb)}" for verb in VERBS["VERBS"]
        ],
    },
)

# SPDX-License-Identifier: Apache-2.0
"""The launch files, run by the real launch and launch_testing; skipped where they are not."""

import contextlib
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from test.support.waiting import wait_until

ROOT = Path(__file__).parents[2]
NEEDED = ("rclpy", "selfcal_msgs", "launch", "launch_ros", "launch_testing")
MISSING = [name for name in NEEDED if find_spec(name) is None]
pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(bool(MISSING), reason=f"needs {' and '.join(MISSING)}"),
]
PLAN = {
    "plan_id": "small",
    "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 8},
    "views": [
        {"name": "identity"},
        {"name": "turned", "rotation_deg": 90},
        {"name": "line", "rotation_deg": 45, "grid": False},
        {"name": "shifted", "translation_pitch": [1, 0]},
        {"name": "back", "translation_pitch": [-1, 0]},
    ],
}


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Return a function that runs a module in a ROS domain of its own."""
    from selfcal_ros.cli.replay import domain

    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros_home"))
    with domain() as environment:

        def call(*words: str) -> subprocess.CompletedProcess:
            return subprocess.run(
                [sys.executable, *words],
                check=False,
                capture_output=True,
                text=True,
                timeout=400,
                cwd=ROOT,
                env=os.environ | dict(environment),
            )

        yield call
        home = f"ROS_HOME={tmp_path / 'ros_home'}".encode()
        wait_until(
            lambda: (
                not [
                    path
                    for path in Path("/proc").glob("[0-9]*/environ")
                    if holds(path, home)
                ]
            ),
            "the end of all that was launched",
        )


def holds(path: Path, what: bytes) -> bool:
    """Return whether the environment of another process holds an entry."""
    with contextlib.suppress(OSError):  # it has just ended
        return path.parent.name != str(os.getpid()) and what in path.read_bytes().split(
            b"\0"
        )
    return False


LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
file, *arguments = sys.argv[1:]
service = LaunchService(noninteractive=True)
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(
    PythonLaunchDescriptionSource(file),
    launch_arguments=[tuple(word.split(":=")) for word in arguments])]))
sys.exit(service.run())
"""


def launched(run, name: str, *arguments: str) -> subprocess.CompletedProcess:
    """Run a launch file to its end; return what it said."""
    return run("-c", LAUNCH, f"launch/{name}", *arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ["params:=config/params/simulated_cell.yaml"],
        [
            "params:=config/params/simulated_camera.yaml",
            "plan:=config/plans/camera.yaml",
            "camera:=config/simulations/camera.yaml",
            "namespace:=cell2",
        ],
    ],
    ids=["detections", "images, in a namespace"],
)
def test_a_whole_calibration(run, tmp_path, arguments):
    plan = tmp_path / "plan.yaml"
    plan.write_text(yaml.safe_dump(PLAN))
    done = run(
        "-m",
        "launch_testing.launch_test",
        "test/launch/whole_calibration.py",
        f"plan:={plan}",
        *arguments,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-6000:]


def test_a_recorder_that_cannot_start_ends_the_launch_with_the_reason(run, tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "kept").write_text("of somebody")
    done = launched(run, "simulated_cell.launch.py", f"bag:={tmp_path / 'bag'}")
    said = done.stdout + done.stderr
    assert "cannot start; its last line above says why" in said
    assert str(tmp_path / "bag") in said
    assert "bag_recorder" in said


def test_a_sequencer_without_its_plan_ends_the_launch_with_the_reason(run, tmp_path):
    done = launched(run, "calibrate.launch.py", f"plan:={tmp_path / 'no.yaml'}")
    said = done.stdout + done.stderr
    assert "no.yaml: no such file; check the path" in said
    assert "cannot start; its last line above says why" in said
    assert done.returncode == 1


@pytest.mark.parametrize("file", ["calibrate", "replay", "simulated_cell"])
def test_a_parameter_file_that_is_not_there_starts_nothing(run, tmp_path, file):
    done = launched(
        run, f"{file}.launch.py", f"params:={tmp_path / 'no.yaml'}", "bag:=x"
    )
    said = done.stdout + done.stderr
    assert f"params:={tmp_path / 'no.yaml'}: no such file; check the path" in said
    assert "process started" not in said
    assert done.returncode == 1


@pytest.mark.parametrize(
    ("file", "argument", "problem"),
    [
        ("calibrate", "compensate:=2", '"compensate" provided value "2" is not valid'),
        ("calibrate", "detect:=maybe", '"detect" provided value "maybe" is not valid'),
        ("replay", "rate:=fast", "rate:=fast: not a number; give the speed"),
    ],
)
def test_a_wrong_value_starts_nothing(run, file, argument, problem):
    """Nodes that it had started would go on without the launch; `run` waits for their end."""
    done = launched(run, f"{file}.launch.py", argument, "bag:=x", "journal:=none")
    assert problem in done.stdout + done.stderr
    assert "process started" not in done.stdout + done.stderr
    assert done.returncode == 1


def test_foxglove_bridge_is_started_where_it_is_wanted(run, tmp_path):
    from ament_index_python.packages import get_packages_with_prefixes

    if "foxglove_bridge" in get_packages_with_prefixes():
        pytest.skip("foxglove_bridge is installed: the launch would not end")
    done = launched(run, "calibrate.launch.py", "foxglove:=true", "journal:=none")
    said = done.stdout + done.stderr
    assert (
        "foxglove:=true: there is no package foxglove_bridge; sudo apt install ros-j"
        in said
    )
    assert "process started" not in said
    assert done.returncode == 1


def test_an_exit_later_ends_nothing():
    from types import SimpleNamespace

    from selfcal_ros.errors import InputError
    from selfcal_ros.nodes.launching import end_if_it_cannot_start

    for code in (0, 1, -9, -2):
        end_if_it_cannot_start(
            SimpleNamespace(process_name="solver-2", returncode=code), None
        )
    with pytest.raises(InputError, match="solver-2: cannot start"):
        end_if_it_cannot_start(
            SimpleNamespace(process_name="solver-2", returncode=2), None
        )

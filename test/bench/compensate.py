# SPDX-License-Identifier: Apache-2.0
"""How old corrected positions are: the compensator beside a node as it is written by hand.

A driver on one processor publishes samples at a rate and takes the corrected ones; the node, a
process of its own, has another processor. The age of a corrected sample is the time from the
publishing of the sample to its arrival. The rival has the executor, the queue and the interpolator
that come first to mind: SingleThreadedExecutor, 5000 samples, RegularGridInterpolator.

The rows of strangers are measured as somebody else would: a publisher that sleeps between its
messages and a listener that spins, both written by hand, share all processors with the node; the
stage wanders over the nodes of the map and beyond its edge.

    python test/bench/compensate.py [--rates 500,1000,2000,10000] [--seconds 10]
"""

import argparse
import contextlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

RATES = (500, 1000, 2000, 10000)
METHODS = {
    "selfcal": [
        "-m",
        "selfcal_ros.nodes.compensator",
        "--ros-args",
        "-p",
        "map:={map}",
        "--log-level",
        "error",
    ],
    "rclpy + RegularGridInterpolator": [__file__, "--rival", "{map}"],
}
PITCH_M, SIZE, LINES = 0.01, 21, 72
SITE, THETA = (3, 15), 0.4
STAMP = struct.Struct("<iI")
STAMP_AT = 4
STRANGER_RATE = 2000
STRANGERS = "selfcal, by strangers"
QUEUE = 100
"""Samples that the listener of strangers lets wait."""
WANDER_S = 2.0
"""Period of the stage of strangers, which goes a tenth beyond the edge of the field."""
SETTLING_S, PATIENCE_S = 2.5, 60.0
"""Longer than from one status of the node to the next; longest wait for the node."""


def error_map():
    """Return the map that both correct by."""
    from selfcal_ros.model.artifact import Artifact
    from test.support.maps import random_map

    return random_map(Artifact(SIZE, PITCH_M, LINES), 3)


def rival(path: str) -> None:
    """Correct samples one by one, as a first draft of a compensator does."""
    import rclpy
    from rclpy._rclpy_pybind11 import RCLError
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import qos_profile_sensor_data
    from scipy.interpolate import RegularGridInterpolator

    from selfcal_ros.files import read_json
    from selfcal_ros.model.result import result_from_dict
    from selfcal_ros.nodes import names

    g = result_from_dict(read_json(path), path).error_map
    sites = (np.arange(SIZE) - SIZE // 2) * PITCH_M
    field = RegularGridInterpolator(
        (sites, sites),
        np.stack([g.gx, g.gy], axis=-1),
        bounds_error=False,
        fill_value=None,
    )
    lines = np.arange(LINES + 1) * 2 * np.pi / LINES
    closed = np.append(g.g_theta, g.g_theta[:1])
    rclpy.init()
    node = rclpy.create_node("compensator")
    publisher = node.create_publisher(
        names.CORRECTED.type, names.CORRECTED.name, qos_profile_sensor_data
    )

    def on_sample(message) -> None:
        x, y, theta = message.position
        true, angle = np.array([x, y]), theta
        for _ in range(4):
            true = (x, y) - field(true)[0]
            angle = theta - np.interp(angle % (2 * np.pi), lines, closed)
        message.position = [*true, angle]
        publisher.publish(message)

    node.create_subscription(
        names.ENCODER.type, names.ENCODER.name, on_sample, names.ENCODER_EITHER[1].qos
    )
    with contextlib.suppress(ExternalShutdownException, RCLError):  # the driver ends it
        rclpy.spin(node)


def drive(method: str, rate: int, seconds: float) -> dict:
    """Return a row of the bench for one method at one rate."""
    from selfcal_ros.cli.processes import domain
    from selfcal_ros.model.result import result_to_dict
    from selfcal_ros.outputs import write_json
    from test.support.maps import result_of

    processors = sorted(os.sched_getaffinity(0))
    with domain() as environment, tempfile.TemporaryDirectory() as folder:
        os.environ.update(environment)
        path = f"{folder}/map.json"
        write_json(path, result_to_dict(result_of(error_map())))
        node = subprocess.Popen(
            [sys.executable, *(word.format(map=path) for word in METHODS[method])],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        try:
            os.sched_setaffinity(node.pid, processors[-1:])
            os.sched_setaffinity(0, processors[:1])
            return {
                "benchmark": f"compensate {rate} Hz",
                "method": method,
                **play(rate, seconds, node.pid),
            }
        finally:
            node.terminate()
            node.wait()


def play(rate: int, seconds: float, pid: int) -> dict:
    """Publish samples and take the corrected ones; return what was measured."""
    import rclpy
    from rclpy.serialization import deserialize_message, serialize_message

    from selfcal_ros.nodes import names

    rclpy.init()
    node = rclpy.create_node("driver")
    out = node.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER.qos
    )
    heard = node.create_subscription(
        names.CORRECTED.type,
        names.CORRECTED.name,
        lambda _: None,
        names.CORRECTED.qos,
        raw=True,
    )
    health = names.of_node("compensator", names.HEALTH)
    said = node.create_subscription(
        health.type, health.name, lambda _: None, health.qos
    )
    found = error_map()
    true = (np.array(SITE) - SIZE // 2) * PITCH_M
    indicated = true + np.array([found.gx[SITE], found.gy[SITE]])
    data = bytearray(
        serialize_message(
            names.ENCODER.type(
                name=["x", "y", "theta"],
                position=[*indicated, THETA],
                velocity=[0.0] * 3,
            )
        )
    )
    ages, newest = [], b""

    def publish() -> None:
        STAMP.pack_into(data, STAMP_AT, *divmod(time.time_ns(), 10**9))
        out.publish(bytes(data))

    def take() -> None:
        nonlocal newest
        while (taken := heard.handle.take_message(heard.msg_type, True)) is not None:
            newest = taken[0]
            sec, nanosec = STAMP.unpack_from(newest, STAMP_AT)
            ages.append((time.time_ns() - sec * 10**9 - nanosec) * 1e-9)

    deadline = time.monotonic() + PATIENCE_S
    while not ages:  # the node is there, and has its map
        if time.monotonic() > deadline:
            raise SystemExit("compensate: waited in vain for a corrected sample")
        publish()
        time.sleep(0.05)
        take()
    ages.clear()
    used, began, sent, total = cpu_s(pid), time.monotonic(), 0, round(rate * seconds)
    while sent < total:
        if time.monotonic() >= began + sent / rate:
            publish()
            sent += 1
        take()
    used = cpu_s(pid) - used
    end = time.monotonic() + SETTLING_S
    while time.monotonic() < end:
        take()
    told = said.handle.take_message(health.type, False)
    skipped = (
        {item.key: item.value for item in told[0].values}["skipped"] if told else None
    )
    error = np.abs(
        np.array(deserialize_message(newest, heard.msg_type).position[:2]) - true
    )
    row = {
        "n": total,
        "seconds": float(np.median(ages)),
        "peak_mb": round(peak_mb(pid), 1),
        "max_error": float(error.max()),
        "cpu_seconds": used,
        "seconds_99": float(np.quantile(ages, 0.99)),
        "seconds_max": max(ages),
        "corrected": len(ages),
        "skipped": skipped,
    }
    rclpy.shutdown()
    return row


def strangers(rate: int, seconds: float) -> dict:
    """Return the row of a publisher and a listener written by somebody else."""
    from selfcal_ros.cli.processes import domain, process
    from selfcal_ros.model.result import result_to_dict
    from selfcal_ros.outputs import write_json
    from test.support.maps import result_of

    with domain() as environment, tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/map.json"
        write_json(path, result_to_dict(result_of(error_map())))
        module, *words = METHODS["selfcal"][1:]
        with process(
            module,
            [word.format(map=path) for word in words],
            environment | {"PYTHONPATH": str(ROOT)},
        ) as node:
            command = [
                sys.executable,
                __file__,
                "--seconds",
                str(seconds),
                "--stranger",
            ]
            listener = subprocess.Popen(
                [*command, "listen", str(rate)],
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
            )
            idle = cpu_s(node.pid)
            subprocess.run(
                [*command, "publish", str(rate)], env=environment, check=True
            )
            used = cpu_s(node.pid) - idle
            row = json.loads(listener.communicate()[0])
            return {
                "benchmark": f"compensate {rate} Hz",
                "method": STRANGERS,
                "n": round(rate * seconds),
                "peak_mb": round(peak_mb(node.pid), 1),
                "max_error": None,
                "cpu_seconds": used,
                **row,
            }


def publish_as_stranger(rate: int, seconds: float) -> None:
    """Publish samples of a stage that wanders, with a pause of sleep between them."""
    import rclpy

    from selfcal_ros.nodes import names

    rclpy.init()
    node = rclpy.create_node("stranger_who_publishes")
    out = node.create_publisher(names.ENCODER.type, names.ENCODER.name, 10)
    while not out.get_subscription_count():
        time.sleep(0.05)
    time.sleep(1.0)
    reach, message = (
        1.1 * (SIZE // 2) * PITCH_M,
        names.ENCODER.type(name=["x", "y", "theta"]),
    )
    began = time.monotonic()
    for number in range(round(rate * seconds)):
        time.sleep(max(began + number / rate - time.monotonic(), 0.0))
        turn = 2 * np.pi * number / rate / WANDER_S
        message.position = [reach * np.cos(turn), 0.0, turn]  # along a row of nodes
        second, nanosecond = divmod(time.time_ns(), 10**9)
        message.header.stamp.sec, message.header.stamp.nanosec = second, nanosecond
        out.publish(message)
    time.sleep(SETTLING_S)


def listen_as_stranger(rate: int, seconds: float) -> None:
    """Print what a listener sees of the corrected samples, as JSON."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    from selfcal_ros.nodes import names

    rclpy.init()
    node = rclpy.create_node("stranger_who_listens")
    ages: list[float] = []
    told: list = []

    def take(message) -> None:
        stamp = message.header.stamp
        ages.append((time.time_ns() - stamp.sec * 10**9 - stamp.nanosec) * 1e-9)

    node.create_subscription(
        names.CORRECTED.type,
        names.CORRECTED.name,
        take,
        QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    health = names.of_node("compensator", names.HEALTH)
    node.create_subscription(health.type, health.name, told.append, health.qos)
    while not ages:
        rclpy.spin_once(node)
    end = time.monotonic() + seconds + SETTLING_S - 0.5
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    skipped = (
        {item.key: item.value for item in told[-1].values}["skipped"] if told else None
    )
    print(
        json.dumps(
            {
                "seconds": float(np.median(ages)),
                "corrected": len(ages),
                "seconds_99": float(np.quantile(ages, 0.99)),
                "seconds_max": max(ages),
                "skipped": skipped,
            }
        )
    )


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def peak_mb(pid: int) -> float:
    """Return the largest resident memory of a process."""
    [line] = (
        line
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("VmHWM")
    )
    return int(line.split()[1]) / 1024


def measured(method: str, rate: int, seconds: float) -> dict:
    """Return the row of `drive` or `strangers` in a process of its own."""
    done = subprocess.run(
        [
            sys.executable,
            __file__,
            "--worker",
            method,
            str(rate),
            "--seconds",
            str(seconds),
        ],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def show(row: dict) -> None:
    """Print a row with the figures that the other benchmarks do not have; CPU is a sample's."""
    print(
        f"{row['benchmark']:<20} {row['method']:<32} {1e3 * row['seconds']:10.3f} "
        f"{1e3 * row['seconds_99']:9.2f} {1e3 * row['seconds_max']:9.1f} "
        f"{row['corrected']:>7}/{row['n']:>7} {row['skipped'] or '':>8} "
        f"{1e6 * row['cpu_seconds'] / row['corrected']:10.0f}",
        flush=True,
    )


def main() -> None:
    """Measure each method at each rate, one after the other, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rates", default=",".join(map(str, RATES)))
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rival", help=argparse.SUPPRESS)
    parser.add_argument("--stranger", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.rival:
        rival(args.rival)
    elif args.stranger:
        act = (
            publish_as_stranger if args.stranger[0] == "publish" else listen_as_stranger
        )
        act(int(args.stranger[1]), args.seconds)
    elif args.worker:
        method, rate = args.worker[0], int(args.worker[1])
        print(
            json.dumps(
                strangers(rate, args.seconds)
                if method == STRANGERS
                else drive(method, rate, args.seconds)
            )
        )
    else:
        print(
            f"{'':<20} {'method':<32} {'median ms':>10} {'99 % ms':>9} {'max ms':>9} "
            f"{'corrected':>15} {'skipped':>8} {'us of CPU':>10}"
        )
        for rate in map(int, args.rates.split(",")):
            for method in METHODS:
                show(measured(method, rate, args.seconds))
        show(measured(STRANGERS, STRANGER_RATE, args.seconds))


if __name__ == "__main__":
    main()

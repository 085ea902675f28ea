# SPDX-License-Identifier: Apache-2.0
"""pose_sequencer: leads through the views of a plan."""

import sys
import time
from dataclasses import replace
from functools import partial
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from selfcal_msgs.action import RunCalibration
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.bagio import convert_in, convert_out
from selfcal_ros.collection.messages import Command
from selfcal_ros.collection.sequencer import ENDED, Sequencer, State
from selfcal_ros.errors import ExitCode, NoDataError, SelfcalError
from selfcal_ros.files import read_yaml
from selfcal_ros.model.view import Plan, plan_from_dict
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill, run


def load_plan(path: str) -> Plan:
    """Return the plan in a PLAN.yaml."""
    return plan_from_dict(read_yaml(path), path)


class PoseSequencer(SelfcalNode):
    """Publishes PLACE and MEASURE for each view; services and an action drive it."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("pose_sequencer", **kwargs)
        path = self.values["plan"]
        self.machine = Sequencer(load_plan(path) if path else None)
        self._own: set[tuple] = set()
        self._goal, self._ended = None, None  # of the action that runs
        self._deadline, self._confirm_at, self._redos = 0.0, 0.0, 0
        self._coverage, self._commanded_ns = 0.0, 0
        self._measured: dict[str, dict[int, str]] = {}
        self._command = self.publisher(names.COMMAND)
        self.subscribe(names.COMMAND, self._on_command)
        self.subscribe(names.STATUS, self._on_status)
        self.subscribe(names.MEASUREMENT, self._on_measurement)
        self.create_service(Trigger, "~/start", partial(self.trigger, act=self._begin))
        machine = self.machine
        for name, act in (("confirm_view", machine.confirm), ("redo_view", machine.redo),
                          ("skip_view", machine.skip), ("abort", machine.abort)):
            do = partial(self._do, act)
            self.create_service(Trigger, f"~/{name}", partial(self.trigger, act=do))
        self._saver = self.create_client(SaveMap, "solver/save_map")
        self._action = ActionServer(
            self, RunCalibration, "~/run_calibration", self._execute,
            goal_callback=self._on_goal, cancel_callback=lambda goal: CancelResponse.ACCEPT)
        self.create_timer(0.05, self.guarded(self._on_timer))
        self.create_timer(1.0, self._report)
        self._waiting = self.values["auto_start"]
        if self._waiting:
            self.machine.need_plan()

    def _on_goal(self, _: Any) -> GoalResponse:
        if self.machine.state in ENDED:
            return GoalResponse.ACCEPT
        self.get_logger().warning(f"goal rejected while {self.machine.state}: abort the plan first")
        return GoalResponse.REJECT

    def _do(self, act: Any) -> str:
        self._send(act())
        return f"{self.machine.state}: view {self.machine.index}"

    def _begin(self) -> str:
        """Start the plan; say what is known of it and who is missing."""
        self._waiting = False
        answer = self._do(self.machine.start)
        known = self._measured.get(self.machine.plan.plan_id, {})
        if known:
            views = ", ".join(known[index] for index in sorted(known))
            answer += f"; measured already: {views} (skip_view keeps a view as it is)"
        if not self._collectors():
            answer += "; no measurement_collector is seen yet: make sure that one runs"
        self.get_logger().info(answer)
        return answer

    def _collectors(self) -> int:
        return self.count_publishers(self.resolve_topic_name(names.STATUS.name))

    def _on_measurement(self, message: Any) -> None:
        self._measured.setdefault(message.plan_id, {})[message.view_index] = message.view_name

    def _report(self) -> None:
        state = "waiting for a measurement_collector" if self._waiting else str(self.machine.state)
        self.diagnose(state, {"view": self.machine.index, "coverage": f"{self._coverage:.3f}"})

    def _send(self, commands: list[Command]) -> None:
        for command in commands:
            command = replace(command, stamp_ns=self.get_clock().now().nanoseconds)
            self._own.add(_key(command))
            self._commanded_ns = command.stamp_ns
            self._command.publish(fill(names.COMMAND.type(), convert_out.command(
                command, self.frame_id)))
            name = command.view.name if command.view else self.machine.plan.plan_id
            self.get_logger().info(f"{command.phase.name} {name}")
            self._coverage = 0.0
            self._confirm_at = time.monotonic() + self.values["settle_time"]
            self._deadline = time.monotonic() + self.values["view_timeout"]
        if self.machine.state in ENDED and self._ended is not None:
            self._ended.set_result(None)

    def _on_command(self, message: Any) -> None:
        if _key(convert_in.command(message)) in self._own:
            return
        said = "another publisher sends view commands: following them; abort ends that"
        if self.machine.state in ENDED:
            self.get_logger().info(said)
        elif self.machine.state is not State.FOLLOWING:  # its own plan stops here
            self.get_logger().warning(said)
        self.machine.foreign_command()
        if self._ended is not None:
            self._ended.set_result(None)

    def _on_status(self, message: Any) -> None:
        if convert_in.stamp_ns(message) < self._commanded_ns:
            return  # of before the command: a redone view would look complete
        expected = message.grid_expected + message.angular_expected
        if message.view_index == self.machine.index and expected:
            self._coverage = (message.grid_done + message.angular_done) / expected
        moved_on = self.machine.status(message.plan_id, message.view_index, message.complete)
        self._redos = 0 if moved_on else self._redos
        self._send(moved_on)

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._waiting and self._collectors():
            self._begin()
        if (self.machine.state is State.PLACING and self.values["auto_confirm"]
                and now >= self._confirm_at):
            self._send(self.machine.confirm())
        timed_out = self.values["view_timeout"] > 0 and now >= self._deadline
        if self.machine.state is State.MEASURING and timed_out:
            view = self.machine.plan.views[self.machine.index].name
            self.get_logger().warning(f"view {view} is not complete in time")
            again = self._redos < self.values["max_redos"]
            self._redos = self._redos + 1 if again else 0
            self._send(self.machine.redo() if again else self.machine.skip())
        if self._goal is not None:
            if self._goal.is_cancel_requested and self.machine.state not in ENDED:
                self._send(self.machine.abort())
            self._feedback()

    def _feedback(self) -> None:
        if self.machine.state in (State.PLACING, State.MEASURING):
            view = self.machine.plan.views[self.machine.index]
            self._goal.publish_feedback(RunCalibration.Feedback(
                view=view.name, view_index=self.machine.index, coverage=self._coverage))

    async def _execute(self, goal: Any) -> Any:
        """Run the plan of an action goal to its end and have the solver save the map."""
        result = RunCalibration.Result()
        try:
            if goal.request.plan_path:
                self.machine.plan = load_plan(goal.request.plan_path)
            self._goal, self._ended = goal, Future()
            self._begin()
            await self._ended
            await self._conclude(goal, result)
        except SelfcalError as error:
            result.error_code, result.message = int(error.exit_code), str(error)
            goal.abort()
        finally:
            self._goal, self._ended = None, None
        return result

    async def _conclude(self, goal: Any, result: Any) -> None:
        if self.machine.state is not State.DONE:
            result.error_code = int(ExitCode.NO_DATA)
            result.message = f"the plan was not measured to its end: {self.machine.state}"
            goal.canceled() if goal.is_cancel_requested else goal.abort()
            return
        path = self.values["result_path"] or f"{self.machine.plan.plan_id}.json"
        if not self._saver.service_is_ready():
            raise NoDataError("run_calibration", "no solver is running", "start one, then save_map")
        answer = await self._saver.call_async(SaveMap.Request(path=path))
        result.error_code, result.message = answer.error_code, answer.message
        result.map_path = path if answer.success else ""
        goal.succeed() if answer.success else goal.abort()


def _key(command: Command) -> tuple:
    return (command.stamp_ns, int(command.phase), command.plan_id, command.view_index)


def main() -> None:
    """Run the node."""
    sys.exit(run(PoseSequencer))


if __name__ == "__main__":
    main()

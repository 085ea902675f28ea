# SPDX-License-Identifier: Apache-2.0
"""pose_sequencer: leads through the views of a plan."""

import sys
from functools import partial
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from selfcal_msgs.action import RunCalibration
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.collection.sequencer import State
from selfcal_ros.errors import ExitCode, NoDataError, SelfcalError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, fill
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.sequencing import SequencingSession, load_plan


class PoseSequencer(SelfcalNode):
    """Publishes PLACE and MEASURE for each view; services and an action drive it."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("pose_sequencer", **kwargs)
        self.session = SequencingSession(self.values, self.ports(self._publish), self._collectors)
        self.session.on_end = self._on_end
        self._goal, self._ended = None, None  # of the action that runs
        self._command = self.publisher(names.COMMAND)
        self.subscribe(names.COMMAND, self.session.take_command)
        self.subscribe(names.STATUS, self.session.take_status)
        self.subscribe(names.MEASUREMENT, self.session.take_measurement)
        self.create_service(Trigger, "~/start", partial(self.trigger, act=self.session.begin))
        machine = self.session.machine
        for name, request in (("confirm_view", machine.confirm), ("redo_view", machine.redo),
                              ("skip_view", machine.skip), ("abort", machine.abort)):
            act = partial(self.session.act, request)
            self.create_service(Trigger, f"~/{name}", partial(self.trigger, act=act))
        self._saver = self.create_client(SaveMap, "solver/save_map")
        self._action = ActionServer(
            self, RunCalibration, "~/run_calibration", self._execute,
            goal_callback=self._on_goal, cancel_callback=lambda goal: CancelResponse.ACCEPT)
        self.create_timer(0.05, self.guarded(self._on_timer))
        self.create_timer(1.0, lambda: self.diagnose(self.session.diagnosis()))

    def _collectors(self) -> int:
        return self.count_publishers(self.resolve_topic_name(names.STATUS.name))

    def _publish(self, _: str, fields: dict[str, Any]) -> None:
        self._command.publish(fill(names.COMMAND.type(), fields))

    def _on_end(self) -> None:
        if self._ended is not None:
            self._ended.set_result(None)

    def _on_goal(self, _: Any) -> GoalResponse:
        if self.session.ended:
            return GoalResponse.ACCEPT
        self.get_logger().warning(
            f"goal rejected while {self.session.machine.state}: abort the plan first")
        return GoalResponse.REJECT

    def _on_timer(self) -> None:
        self.session.tick()
        if self._goal is not None:
            if self._goal.is_cancel_requested:
                self.session.abort()
            self._feedback()

    def _feedback(self) -> None:
        view = self.session.current
        if view is not None:
            self._goal.publish_feedback(RunCalibration.Feedback(
                view=view.name, view_index=self.session.machine.index,
                coverage=self.session.coverage))

    async def _execute(self, goal: Any) -> Any:
        """Run the plan of an action goal to its end and have the solver save the map."""
        result = RunCalibration.Result()
        try:
            if goal.request.plan_path:
                self.session.machine.plan = load_plan(goal.request.plan_path)
            self._goal, self._ended = goal, Future()
            self.session.begin()
            await self._ended
            await self._conclude(goal, result)
        except SelfcalError as error:
            result.error_code, result.message = int(error.exit_code), str(error)
            goal.abort()
        finally:
            self._goal, self._ended = None, None
        return result

    async def _conclude(self, goal: Any, result: Any) -> None:
        machine = self.session.machine
        if machine.state is not State.DONE:
            result.error_code = int(ExitCode.NO_DATA)
            result.message = f"the plan was not measured to its end: {machine.state}"
            goal.canceled() if goal.is_cancel_requested else goal.abort()
            return
        path = self.values["result_path"] or f"{machine.plan.plan_id}.json"
        if not self._saver.service_is_ready():
            raise NoDataError("run_calibration", "no solver is running", "start one, then save_map")
        answer = await self._saver.call_async(SaveMap.Request(path=path))
        result.error_code, result.message = answer.error_code, answer.message
        result.map_path = path if answer.success else ""
        goal.succeed() if answer.success else goal.abort()


def main() -> None:
    """Run the node."""
    sys.exit(run(PoseSequencer))


if __name__ == "__main__":
    main()

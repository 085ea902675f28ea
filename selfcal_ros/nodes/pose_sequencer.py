# SPDX-License-Identifier: Apache-2.0
"""pose_sequencer: commands the views of a plan, alone or as the action run_calibration."""

import sys
import time
from functools import partial
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from selfcal_msgs.action import RunCalibration
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.collection.sequencer import State
from selfcal_ros.collection.settings.estimator import read_plan
from selfcal_ros.collection.settings.nodes import SequencerSettings
from selfcal_ros.errors import ExitCode, NoDataError, as_answer
from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import diagnosis_of
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured
from selfcal_ros.nodes.running import run
from selfcal_ros.sessions.compensating import plan_file_name
from selfcal_ros.sessions.health import Level
from selfcal_ros.sessions.sequencing import SequencingSession


class CalibrationAction:
    """Serve run_calibration for a sequencer: one goal at a time, none while it is not active.

    Parameters
    ----------
    node : ManagedNode
        The sequencer's node, during configuration.
    session : SequencingSession
        Runs the plan.
    """

    def __init__(self, node: ManagedNode[SequencerSettings], session: SequencingSession) -> None:
        self._node, self._session = node, session
        self._taken = False  # from the acceptance of a goal, before it is executed, to its end
        self._goal: Any = None
        self._feedback: Any = None  # of this goal, the last
        self._ended: Future | None = None
        self._saved: Future | None = None
        self._save_until = 0.0
        session.on_end = lambda: _complete(self._ended)
        self._saver = node.own(node.create_client(SaveMap, "solver/save_map"),
                               node.destroy_client)
        node.own(ActionServer(
            node, RunCalibration, "~/run_calibration", self._execute,
            goal_callback=self._on_goal, handle_accepted_callback=self._on_accepted,
            cancel_callback=lambda goal: CancelResponse.ACCEPT),
            ActionServer.destroy)

    def tick(self) -> None:
        """Give changed feedback; handle a cancelled goal and a solver that does not answer."""
        if self._goal is None:
            return
        if self._goal.is_cancel_requested and not self._session.ended:
            self._session.give_up()
        if time.monotonic() > self._save_until:
            _complete(self._saved)
        view = self._session.current
        if view is None:
            return
        feedback = RunCalibration.Feedback(
            view=view.name, view_index=self._session.machine.index,
            coverage=self._session.coverage)
        if feedback != self._feedback:
            self._feedback = feedback
            self._goal.publish_feedback(feedback)

    def _on_goal(self, _: Any) -> GoalResponse:
        active = self._node.state == "active"
        if active and self._session.ended and not self._taken:
            return GoalResponse.ACCEPT
        why = (f"the node is {self._node.state}: activate it first" if not active else
               "another one is executed: cancel it, or wait for its end" if self._taken else
               f"{self._session.machine.state}: abort the plan first")
        self._node.say(Level.WARN, f"goal rejected while {why}")
        return GoalResponse.REJECT

    def _on_accepted(self, goal: Any) -> None:
        self._taken = True
        try:
            goal.execute()
        except Exception:  # counted where it is caught; the next goal is not rejected for it
            self._taken = False
            raise

    async def _execute(self, goal: Any) -> Any:
        """Run the plan of a goal to its end and have the solver save the map."""
        result = RunCalibration.Result()
        try:
            if goal.request.plan_path:
                self._session.machine.plan = read_plan(goal.request.plan_path)
            self._goal, self._ended, self._feedback = goal, Future(), None
            self._session.begin()
            await self._ended
            await self._conclude(goal, result)
        except Exception as error:
            code, result.message = as_answer(error)
            result.error_code = int(code)
            goal.abort()
        finally:
            self._goal, self._ended, self._taken = None, None, False
        return result

    async def _conclude(self, goal: Any, result: Any) -> None:
        machine = self._session.machine
        if machine.state is not State.DONE:
            result.error_code = int(ExitCode.NO_DATA)
            result.message = f"the plan was not measured to its end: {machine.state}"
            goal.canceled() if goal.is_cancel_requested else goal.abort()
            return
        answer = await self._save(
            self._node.settings.result_path or plan_file_name(machine.need_plan().plan_id))
        result.message, result.map_path = answer.message, answer.path
        if answer.success:
            result.error_code = int(ExitCode.DONE)
            goal.succeed()
        else:
            result.error_code = answer.error_code or int(ExitCode.INTERNAL)
            goal.abort()

    async def _save(self, path: str) -> Any:
        """Return the solver's answer; NoDataError after a time-out."""
        if not self._saver.service_is_ready():
            raise NoDataError("run_calibration", "no solver is running", "start one, then save_map")
        patience = self._node.settings.save_timeout
        self._saved, self._save_until = Future(), time.monotonic() + patience
        answer = self._saver.call_async(SaveMap.Request(path=path))
        answer.add_done_callback(self._node.guarded(lambda _: _complete(self._saved)))
        try:
            await self._saved
        finally:
            self._saved = None
        if not answer.done():
            self._saver.remove_pending_request(answer)
            raise NoDataError("run_calibration", f"the solver has not saved the map in {patience:g}"
                              " s", "check the solver, then call save_map")
        return answer.result()


def _complete(future: Future | None) -> None:
    if future is not None and not future.done():
        future.set_result(None)


COMPANIONS = ("measurement_collector", "solver")
TICK_S = 0.05


class PoseSequencer(ManagedNode[SequencerSettings]):
    """Publish PLACE and MEASURE for each view, driven by services and an action."""

    session = WhileConfigured[SequencingSession]()
    _action = WhileConfigured[CalibrationAction]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(SequencerSettings, **kwargs)

    def configure(self) -> None:
        """Create the session, with its plan, the publisher of commands, and the action.

        Without a server of the action, a goal would wait for an answer until the activation.
        """
        command = self.output(names.NEWEST_COMMAND)
        self.session = SequencingSession(
            self.settings, self.ports(lambda _, fields: command(fields)))
        self._action = CalibrationAction(self, self.session)

    def activate(self) -> None:
        """Subscribe to the companions, offer services."""
        session = self.session
        self.subscribe_with_age(names.COMMAND, self._on_command)
        self.subscribe(names.STATUS_AS_IT_COMES, session.take_status)
        self.subscribe(names.MEASUREMENT, session.take_measurement)
        for node in COMPANIONS:
            self.subscribe_with_age(names.of_node(node, names.HEALTH),
                                    partial(self._on_health, node))
        machine = session.machine
        for name, act in (
                ("start", session.begin), ("abort", session.give_up),
                ("confirm_view", lambda: session.act(machine.confirm)),
                ("redo_view", lambda: session.act(machine.redo)),
                ("skip_view", lambda: session.act(machine.skip))):
            self.service(Trigger, f"~/{name}", lambda request, act=act: act())
        self.every(TICK_S, self._on_timer)

    def _on_command(self, message: Any, is_older: bool) -> None:
        """Take a command, except the last one of a sequencer that has been shut down."""
        if not is_older or self.count_publishers(names.COMMAND.name) > 1:
            self.session.take_command(message)

    def _on_health(self, node: str, status: Any, is_older: bool) -> None:
        """Take the present health of a companion: a run is resumed where the collector is."""
        if not is_older:
            self.session.presence.take(node, diagnosis_of(status))

    def _on_timer(self) -> None:
        self.session.tick()
        self._action.tick()


def main() -> None:
    """Run the node."""
    sys.exit(run(PoseSequencer))


if __name__ == "__main__":
    main()

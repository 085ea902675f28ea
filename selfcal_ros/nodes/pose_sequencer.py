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
from selfcal_ros.errors import ExitCode, NoDataError, as_answer
from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import diagnosis_of
from selfcal_ros.nodes.managed import ManagedNode, WhileConfigured
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.compensating import plan_file_name
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.nodes.sessions.sequencing import SequencingSession
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import SequencerSettings


class CalibrationAction:
    """Serve run_calibration for a sequencer: one goal at a time, none while it is not active.

    It is offered as long as the node exists: a goal is answered in every state, and the result of
    one that the node's cleanup ends is still sent.

    Parameters
    ----------
    node : ManagedNode
        The sequencer's node.
    """

    def __init__(self, node: ManagedNode[SequencerSettings]) -> None:
        self._node = node
        self._session: SequencingSession | None = None
        self._saver: Any = None
        # from the acceptance of a goal, before it is executed, to its end
        self._taken = False
        self._goal: Any = None
        self._feedback: Any = None  # of this goal, the last
        self._ended: Future | None = None
        self._saved: Future | None = None
        self._save_until = 0.0
        server = ActionServer(
            node,
            RunCalibration,
            "~/run_calibration",
            self._execute,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )
        self.destroy = server.destroy

    def serve(self, session: SequencingSession) -> None:
        """Execute goals with a session, until the configuration of the node is undone."""
        self._session = session
        session.on_end = lambda: _complete(self._ended)
        self._saver = self._node.own(
            self._node.create_client(SaveMap, "solver/save_map"),
            self._node.destroy_client,
        )
        self._node.own(None, lambda _: self._leave())

    def _leave(self) -> None:
        """End the goal in execution, whose plan is not measured to its end."""
        self._session = None
        _complete(self._ended)
        _complete(self._saved)

    def tick(self) -> None:
        """Give changed feedback; handle a cancelled goal and a solver that does not answer."""
        session = self._session
        if self._goal is None or session is None:
            return
        if self._goal.is_cancel_requested and not session.ended:
            session.give_up()
        if time.monotonic() > self._save_until:
            _complete(self._saved)
        view = session.current
        if view is None:
            return
        feedback = RunCalibration.Feedback(
            view=view.name, view_index=session.machine.index, coverage=session.coverage
        )
        if feedback != self._feedback:
            self._feedback = feedback
            self._goal.publish_feedback(feedback)

    def _on_goal(self, _: Any) -> GoalResponse:
        session = self._session if self._node.state == "active" else None
        if session is not None and session.ended and not self._taken:
            return GoalResponse.ACCEPT
        why = (
            f"the node is {self._node.state}: activate it first"
            if session is None
            else "another one is executed: cancel it, or wait for its end"
            if self._taken
            else f"{session.machine.state}: abort the plan first"
        )
        self._node.say(Level.WARN, f"goal rejected while {why}")
        return GoalResponse.REJECT

    def _on_accepted(self, goal: Any) -> None:
        self._taken = True
        try:
            goal.execute()
        except Exception:
            # counted where it is caught; the next goal is not rejected for it
            self._taken = False
            raise

    async def _execute(self, goal: Any) -> Any:
        """Run the plan of a goal to its end and have the solver save the map."""
        result = RunCalibration.Result()
        try:
            session: SequencingSession = self._node.session
            if goal.request.plan_path:
                session.machine.plan = read_plan(goal.request.plan_path)
            self._goal, self._ended, self._feedback = goal, Future(), None
            session.begin()
            await self._until(self._ended, session)
            await self._conclude(goal, result, session)
        except Exception as error:
            code, result.message = as_answer(error)
            result.error_code = int(code)
            goal.abort()
        finally:
            self._goal, self._ended, self._taken = None, None, False
        return result

    async def _until(self, future: Future, session: SequencingSession) -> None:
        """Wait for a future; NoDataError if the session has been cleaned up meanwhile."""
        await future
        if session is not self._session:
            raise NoDataError(
                "run_calibration",
                "pose_sequencer was cleaned up before the map was saved",
                "call solver/save_map"
                if session.machine.state is State.DONE
                else "activate it again: its service start resumes the plan",
            )

    async def _conclude(
        self, goal: Any, result: Any, session: SequencingSession
    ) -> None:
        machine = session.machine
        if machine.state is not State.DONE:
            result.error_code = int(ExitCode.NO_DATA)
            result.message = f"the plan was not measured to its end: {machine.state}"
            goal.canceled() if goal.is_cancel_requested else goal.abort()
            return
        answer = await self._save(
            session,
            self._node.settings.result_path
            or plan_file_name(machine.need_plan().plan_id),
        )
        result.message, result.map_path = answer.message, answer.path
        if answer.success:
            result.error_code = int(ExitCode.DONE)
            goal.succeed()
        else:
            result.error_code = answer.error_code or int(ExitCode.INTERNAL)
            goal.abort()

    async def _save(self, session: SequencingSession, path: str) -> Any:
        """Return the solver's answer; NoDataError after a time-out."""
        if not self._saver.service_is_ready():
            raise NoDataError(
                "run_calibration", "no solver is running", "start one, then save_map"
            )
        patience = self._node.settings.save_timeout
        self._saved, self._save_until = Future(), time.monotonic() + patience
        answer = self._saver.call_async(SaveMap.Request(path=path))
        answer.add_done_callback(self._node.guarded(lambda _: _complete(self._saved)))
        try:
            await self._until(self._saved, session)
        finally:
            self._saved = None
        if not answer.done():
            self._saver.remove_pending_request(answer)
            raise NoDataError(
                "run_calibration",
                f"the solver has not saved the map in {patience:g} s",
                "check the solver, then call save_map",
            )
        return answer.result()


def _complete(future: Future | None) -> None:
    if future is not None and not future.done():
        future.set_result(None)


COMPANIONS = ("measurement_collector", "solver")
TICK_S = 0.05


class PoseSequencer(ManagedNode[SequencerSettings]):
    """Publish PLACE and MEASURE for each view, driven by services and an action."""

    session = WhileConfigured[SequencingSession]()

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(SequencerSettings, **kwargs)
        self._action = CalibrationAction(self)

    def configure(self) -> None:
        """Create the session, with its plan, and the publisher of commands."""
        command = self.output(names.NEWEST_COMMAND)
        self.session = SequencingSession(
            self.settings, self.ports(lambda _, fields: command(fields))
        )
        self._action.serve(self.session)

    def destroy_node(self) -> None:
        """Undo everything, the action included."""
        if hasattr(self, "_action"):  # with parameters that were not refused
            self._action.destroy()
        super().destroy_node()

    def activate(self) -> None:
        """Subscribe to the companions, offer services."""
        session = self.session
        self.subscribe_with_age(names.COMMAND, self._on_command)
        self.subscribe(names.STATUS_AS_IT_COMES, session.take_status)
        self.subscribe(names.MEASUREMENT, session.take_measurement)
        for node in COMPANIONS:
            self.subscribe_with_age(
                names.of_node(node, names.HEALTH), partial(self._on_health, node)
            )
        machine = session.machine
        for name, act in (
            ("start", session.begin),
            ("abort", session.give_up),
            ("confirm_view", lambda: session.act(machine.confirm)),
            ("redo_view", lambda: session.act(machine.redo)),
            ("skip_view", session.skip),
        ):
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

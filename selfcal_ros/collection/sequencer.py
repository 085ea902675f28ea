# SPDX-License-Identifier: Apache-2.0
"""The sequencer's state machine: the next command, without ROS and clock."""

from dataclasses import dataclass
from enum import StrEnum

from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.model.view import Plan, plan_keys


class State(StrEnum):
    """State of the sequencer."""

    IDLE = "idle"
    PLACING = "waiting for the plate to be placed"
    MEASURING = "measuring"
    DONE = "done"
    ABORTED = "aborted"
    FOLLOWING = "following recorded commands"


ENDED = (State.IDLE, State.DONE, State.ABORTED)


@dataclass
class Sequencer:
    """Steps through a plan: PLACE, wait for confirmation, MEASURE, wait for completion, DONE.

    Every transition returns the commands to publish, with stamp 0: the caller stamps
    them. Requests that do not fit the state raise InputError and change nothing.

    Attributes
    ----------
    plan : Plan or None
        Plan to run.
    state : State
        Present state.
    index : int
        Current view.
    skipped : list of str
        Names of views that were skipped.
    """

    plan: Plan | None = None
    state: State = State.IDLE
    index: int = 0

    def __post_init__(self) -> None:
        """Start with nothing skipped."""
        self.skipped: list[str] = []

    def start(self) -> list[Command]:
        """Begin the plan with its first view."""
        self._begin("start", 0)
        return self._place()

    def resume(self, index: int, phase: Phase) -> Command:
        """Resume a run at the view and the command (PLACE or MEASURE) that it had reached."""
        self._begin("resume", index)
        self.state = State.PLACING if phase == Phase.PLACE else State.MEASURING
        return self._command(phase)

    def _begin(self, request: str, index: int) -> None:
        """Go to a view of the plan; refuse to do so while another run lasts."""
        if self.state not in ENDED:
            raise InputError(
                "pose_sequencer",
                f"cannot {request} while {self.state}",
                "abort the plan first",
            )
        self.need_plan()
        self.skipped, self.index = [], index

    def need_plan(self) -> Plan:
        """Return the plan to run; raise InputError if there is none."""
        if self.plan is None:
            raise InputError(
                "pose_sequencer", "there is no plan", "set the parameter 'plan'"
            )
        return self.plan

    def confirm(self) -> list[Command]:
        """Measure: the plate is placed."""
        if self.state is not State.PLACING:
            raise InputError(
                "pose_sequencer",
                f"confirm_view does not fit while {self.state}",
                "redo_view has the plate placed again"
                if self.state is State.MEASURING
                else "start a plan first",
            )
        self.state = State.MEASURING
        return [self._command(Phase.MEASURE)]

    def status(self, plan_id: str, view_index: int, complete: bool) -> list[Command]:
        """Continue when the current view is complete; other statuses are ignored."""
        current = (
            self.state is State.MEASURING
            and self.plan is not None
            and plan_id == self.plan.plan_id
            and view_index == self.index
        )
        return self._advance() if current and complete else []

    def redo(self) -> list[Command]:
        """Place the current view again, superseding its readings."""
        self._need_view("redo")
        return self._place()

    def skip(self) -> list[Command]:
        """Keep the current view as it is and continue with the next."""
        self._need_view("skip")
        self.skipped.append(self.need_plan().views[self.index].name)
        return self._advance()

    def abort(self) -> list[Command]:
        """Abort the plan; the collector keeps the measurements.

        While following another sequencer's commands it only stops following, and can be
        started again.
        """
        if self.state is State.FOLLOWING:
            self.state = State.IDLE
            return []
        self._need_view("abort")
        self.state = State.ABORTED
        return [self._command(Phase.ABORT)]

    def _need_view(self, request: str) -> None:
        """Refuse a request if no view is being placed or measured."""
        if self.state not in (State.PLACING, State.MEASURING):
            raise InputError(
                "pose_sequencer",
                f"nothing to {request} while {self.state}",
                "start a plan first",
            )

    def foreign_command(self) -> None:
        """Follow another publisher's command: recorded commands take precedence."""
        self.state = State.FOLLOWING

    def _place(self) -> list[Command]:
        self.state = State.PLACING
        return [self._command(Phase.PLACE)]

    def _advance(self) -> list[Command]:
        self.index += 1
        if self.index < len(self.need_plan().views):
            return self._place()
        self.state = State.DONE
        return [self._command(Phase.DONE)]

    def _command(self, phase: Phase) -> Command:
        plan = self.need_plan()
        number = len(plan.views)
        if phase in (Phase.DONE, Phase.ABORT):
            return Command(0, phase, plan.plan_id, self.index, views_planned=number)
        return Command(
            stamp_ns=0,
            phase=phase,
            plan_id=plan.plan_id,
            view_index=self.index,
            view=plan.views[self.index],
            artifact=plan.artifact,
            views_planned=number,
            model_terms=plan.model_terms,
            artifact_from=plan.artifact_from,
            **plan_keys(plan),
        )

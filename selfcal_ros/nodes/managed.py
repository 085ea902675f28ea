# SPDX-License-Identifier: Apache-2.0
"""Managed nodes: configured, activated and taken down in steps, by themselves or by a manager."""

import traceback
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial, wraps
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from selfcal_ros.collection.settings.parameter import ManagedSettings
from selfcal_ros.errors import SelfcalError, first_line
from selfcal_ros.nodes.base import NodeBase
from selfcal_ros.sessions.ports import Diagnosis, Level


class WhileConfigured[T]:
    """An attribute of a managed node that exists from its configuring to its taking down.

    Read at another time it raises SelfcalError: no code of a node has to ask if there is one.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, node: "ManagedNode", owner: type) -> T:
        """Return what `configure` or `activate` has set."""
        try:
            return node.held[self._name]
        except KeyError:
            raise SelfcalError(f"{node.get_name()}: there is no {self._name.strip('_')} while "
                               f"{node.state}; configure the node first") from None

    def __set__(self, node: "ManagedNode", value: T) -> None:
        """Hold `value` until the node is taken down."""
        node.held[self._name] = value


def stop(worker: Executor) -> None:
    """Let a worker go; what still runs in it is not waited for."""
    worker.shutdown(wait=False, cancel_futures=True)


class ManagedNode[S: ManagedSettings](NodeBase[S], LifecycleNode):
    """A lifecycle node whose errors in transitions are told, and which leaves nothing behind.

    `configure` makes the session and what it publishes on, `activate` what it hears, answers and
    does by the clock. Deactivated, it keeps its session and its latched messages; cleaned up,
    nothing. An error in a transition is logged, told in the health at level ERROR, and leads
    through the state of error processing to ``unconfigured``.

    Parameters
    ----------
    kind : type
        The node's settings.
    **kwargs
        For rclpy.node.Node, e.g. parameter_overrides.
    """

    def __init__(self, kind: type[S], **kwargs: Any) -> None:
        self.problem: Exception | None = None
        self._made: dict[str, list[Callable[[], Any]]] = {"configure": [], "activate": []}
        self._making, self._is_gone = "", False
        self.held: dict[str, Any] = {}
        super().__init__(kind.NODE, **kwargs)
        self.prepare(kind)
        change = self._service_change_state
        change.callback = partial(self._change_state, change.callback)

    def configure(self) -> None:
        """Make the session and the publishers."""

    def activate(self) -> None:
        """Make subscriptions, services and timers."""

    def diagnose_session(self) -> Diagnosis:
        """Return what the session has to say; asked in the state ``active`` only."""
        return Diagnosis(Level.OK, "running")

    def autostart(self) -> None:
        """Configure and activate, if the parameter ``autostart`` says so; raise what fails."""
        if self.settings.autostart:
            for step in (self.trigger_configure, self.trigger_activate):
                step()
                if self.problem is not None:
                    raise self.problem

    @property
    def state(self) -> str:
        """Label of the lifecycle state; ``finalized`` once the node is destroyed."""
        return "finalized" if self._is_gone else self._state_machine.current_state[1]

    def own(self, entity: Any, destroy: Callable[[Any], Any]) -> Any:
        """Return `entity`, to be destroyed when the step that makes it is undone."""
        if self._making:
            self._made[self._making].append(partial(destroy, entity))
        return entity

    def guarded(self, callback: Callable[..., Any], place: str = "") -> Callable[..., Any]:
        """Return a guarded callback that does nothing once the step that made it is undone.

        An executor may still call what was due when it was taken down.
        """
        inner, step = super().guarded(callback, place), self._making
        if not step:
            return inner
        mine = self._made[step]
        return wraps(callback)(lambda *args: inner(*args) if self._made[step] is mine else None)

    def diagnosis(self) -> Diagnosis:
        """Return the state of the node where it is not active, else what the session says."""
        if self.state == "active":
            return self.diagnose_session()
        if self.problem is not None:
            return Diagnosis(Level.ERROR, f"{self.state}: {first_line(self.problem)}")
        return Diagnosis(Level.WARN, f"{self.state}: a managed node that waits to be activated")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make what `configure` makes."""
        return self._make("configure", self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make what `activate` makes."""
        return self._make("activate", self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down what `activate` made."""
        return self._unmake("activate")

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down everything."""
        return self._unmake("activate", "configure")

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down everything."""
        return self._unmake("activate", "configure")

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down everything; the node can be configured anew."""
        return self._unmake("activate", "configure")

    def destroy_node(self) -> None:
        """Take everything down, the name in the graph included.

        rclpy 7.1 leaves the state machine, which holds on to the node: until Python collects
        its garbage, the name would stay in the graph, without any topic.
        """
        self._unmake("activate", "configure")
        super().destroy_node()
        self._is_gone = True  # a state machine that is asked after its end ends the process
        self._state_machine.destroy_when_not_in_use()

    def _make(self, step: str, make: Callable[[], None]) -> TransitionCallbackReturn:
        self.problem, self._making = None, step
        try:
            make()
        except Exception as error:  # rclpy would swallow it without a word
            return self._fail(step, error)
        finally:
            self._making = ""
        return TransitionCallbackReturn.SUCCESS

    def _unmake(self, *steps: str) -> TransitionCallbackReturn:
        try:
            for step in steps:
                while self._made[step]:
                    self._made[step].pop()()
                self._made[step] = []  # what it made is called no more
            if "configure" in steps:
                self._heard_on.clear()
                self.alone_on.clear()
                self.held.clear()
        except Exception as error:
            return self._fail(f"take down {steps[0]}", error)
        return TransitionCallbackReturn.SUCCESS

    def _fail(self, step: str, error: Exception) -> TransitionCallbackReturn:
        self.problem = error
        self.say(Level.ERROR, f"cannot {step}: {first_line(error)}")
        if not isinstance(error, SelfcalError):
            for line in traceback.format_exception(error):
                for part in line.splitlines():
                    self.say(Level.ERROR, part)
        self.report()
        return TransitionCallbackReturn.ERROR

    def _change_state(self, change: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        """Answer a transition that does not exist in this state with False; rclpy would raise."""
        try:
            response = change(request, response)
        except RCLError as error:
            self.say(Level.WARN, f"no such transition while {self.state}: {first_line(error)}")
            response.success = False
        self.report()
        return response

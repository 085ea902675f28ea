# SPDX-License-Identifier: Apache-2.0
"""Managed nodes: configured, activated and cleaned up in steps, by themselves or by a manager."""

import traceback
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial, wraps
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from selfcal_ros.errors import SelfcalError, first_line
from selfcal_ros.nodes.base import NodeBase
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.settings.parameter import ManagedSettings


class WhileConfigured[T]:
    """An attribute of a managed node that exists only while it is configured.

    Read at another time it raises SelfcalError, so that nodes need not check for it.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, node: "ManagedNode", owner: type) -> T:
        """Return the value set by `configure` or `activate`."""
        try:
            return node.held[self._name]
        except KeyError:
            raise SelfcalError(
                f"{node.get_name()}: there is no {self._name.strip('_')} while "
                f"{node.state}; configure the node first"
            ) from None

    def __set__(self, node: "ManagedNode", value: T) -> None:
        """Keep `value` until the node is cleaned up."""
        node.held[self._name] = value


def stop(worker: Executor) -> None:
    """Release a worker without waiting for its present task."""
    worker.shutdown(wait=False, cancel_futures=True)


class ManagedNode[S: ManagedSettings](NodeBase[S], LifecycleNode):
    """A lifecycle node that reports errors in transitions and leaves nothing behind.

    `configure` creates session and publishers, `activate` subscriptions, services and timers.
    Deactivated, it keeps its session and its latched messages; cleaned up, nothing. An error in a
    transition is logged, in the health at level ERROR, and leads through the state of error
    processing to ``unconfigured``. `kind` is the class of the node's settings; the other arguments
    are those of rclpy.node.Node.
    """

    session: Any  # set by `configure`

    def __init__(self, kind: type[S], **kwargs: Any) -> None:
        self.problem: Exception | None = None
        self._made: dict[str, list[Callable[[], Any]]] = {
            "configure": [],
            "activate": [],
        }
        self._making, self._is_gone = "", False
        self.held: dict[str, Any] = {}
        super().__init__(kind.NODE, **kwargs)
        self.prepare(kind)
        change = self._service_change_state
        change.callback = partial(self._change_state, change.callback)

    def configure(self) -> None:
        """Create the session and the publishers."""

    def activate(self) -> None:
        """Create subscriptions, services and timers."""

    def diagnose_session(self) -> Diagnosis:
        """Return the diagnosis of the session, in the state ``active`` only."""
        return self.session.diagnosis()

    def autostart(self) -> None:
        """Configure and activate if the parameter ``autostart`` is set; raise on failure."""
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
        """Return `entity`, to be destroyed when the step that created it is undone."""
        if self._making:
            self._made[self._making].append(partial(destroy, entity))
        return entity

    def guarded(
        self, callback: Callable[..., Any], place: str = ""
    ) -> Callable[..., Any]:
        """Return a guarded callback that does nothing once the step that created it is undone.

        An executor may still call callbacks that were due when they were removed.
        """
        inner = super().guarded(callback, place)
        step = self._making
        if not step:
            return inner
        mine = self._made[step]
        return wraps(callback)(
            lambda *args: inner(*args) if self._made[step] is mine else None
        )

    def diagnosis(self) -> Diagnosis:
        """Return the state of the node if not active, else the diagnosis of the session."""
        if self.state == "active":
            return self.diagnose_session()
        if self.state == "finalized":
            return Diagnosis(
                Level.ERROR,
                "finalized: shut down on request; end this process and start the node again",
            )
        if self.problem is not None:
            return Diagnosis(Level.ERROR, f"{self.state}: {first_line(self.problem)}")
        return Diagnosis(
            Level.WARN, f"{self.state}: a managed node that waits to be activated"
        )

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `configure`."""
        return self._make("configure", self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `activate`."""
        return self._make("activate", self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo `activate`."""
        return self._unmake("activate")

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo everything."""
        return self._unmake("activate", "configure")

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo everything."""
        return self._unmake("activate", "configure")

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo everything; the node can be configured again."""
        return self._unmake("activate", "configure")

    def close(self) -> None:
        """Undo everything, and finish its work with that: what waits is taken, files are ended."""
        self._unmake("activate", "configure")

    def destroy_node(self) -> None:
        """Undo everything, and remove the name from the graph.

        rclpy 7.1 leaves the state machine, which references the node: until garbage
        collection the name would stay in the graph, without any topic.
        """
        self.close()
        super().destroy_node()
        self._is_gone = True  # a state machine used after its end ends the process
        self._state_machine.destroy_when_not_in_use()

    def _make(self, step: str, make: Callable[[], None]) -> TransitionCallbackReturn:
        self.problem, self._making = None, step
        try:
            make()
        except Exception as error:  # rclpy would ignore it silently
            return self._fail(step, error)
        finally:
            self._making = ""
        return TransitionCallbackReturn.SUCCESS

    def _unmake(self, *steps: str) -> TransitionCallbackReturn:
        try:
            for step in steps:
                while self._made[step]:
                    self._made[step].pop()()
                self._made[step] = []  # its callbacks are no longer called
            if "configure" in steps:
                self._subscribed.clear()
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
                for printed_line in line.splitlines():
                    self.say(Level.ERROR, printed_line)
        self.report()
        return TransitionCallbackReturn.ERROR

    def _change_state(
        self, change: Callable[[Any, Any], Any], request: Any, response: Any
    ) -> Any:
        """Answer an invalid transition with False; rclpy would raise."""
        try:
            response = change(request, response)
        except RCLError as error:
            self.say(
                Level.WARN,
                f"no such transition while {self.state}: {first_line(error)}",
            )
            response.success = False
        self.report()
        return response

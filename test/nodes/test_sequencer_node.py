# SPDX-License-Identifier: Apache-2.0
"""pose_sequencer: services, status, foreign commands, time-outs and the action."""

from itertools import pairwise, product
from types import SimpleNamespace

import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.action import ActionClient
from rclpy.task import Future
from selfcal_msgs.action import RunCalibration
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.collection.sequencer import State
from selfcal_ros.nodes import names, pose_sequencer
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from test.support.ros import Graph
from test.support.sessions import plan_file, small_plan

PLAN = small_plan()
PLACE, MEASURE, DONE, ABORT = Phase


class Desk:
    """A sequencer with a plan, what it commands, and a collector's voice."""

    def __init__(self, graph: Graph, folder, **parameters) -> None:
        self.graph = graph
        self.plan = plan_file(folder, PLAN)
        self.node = graph.node(
            PoseSequencer, **({"plan": self.plan, "start_checks": False} | parameters)
        )
        self.heard = graph.listen(names.COMMAND)
        self.status = graph.publisher(names.STATUS)

    def ask(self, service: str):
        return self.graph.call(Trigger, f"pose_sequencer/{service}")

    @property
    def commands(self) -> list[tuple[Phase, int]]:
        return [(Phase(m.phase), m.view_index) for m in self.heard]

    def expect(self, *commands) -> None:
        self.graph.until(lambda: len(self.heard) >= len(commands), f"{commands}")
        assert self.commands == list(commands)

    def complete(
        self,
        index: int,
        *,
        plan_id: str = PLAN.plan_id,
        complete: bool = True,
        age_ns: int = 0,
    ) -> None:
        stamp = to_model.stamp_ns(self.heard[-1]) - age_ns if self.heard else 0
        self.status.publish(
            fill(
                names.STATUS.type(),
                {
                    "header": from_model.header(stamp, "stage"),
                    "plan_id": plan_id,
                    "view_index": index,
                    "complete": complete,
                    "grid_expected": 25,
                    "grid_done": 25 if complete else 5,
                    "angular_expected": 0,
                    "run_id": self.heard[-1].run_id if self.heard else "",
                },
            )
        )


def all_alive(graph: Graph, **values: str) -> None:
    """Let the companions tell from now on that all are there."""
    graph.health(
        "measurement_collector",
        **{"encoder_heard": "yes", "detections_matched": "yes"} | values,
    )
    graph.health("solver")


@pytest.fixture
def desk(graph, tmp_path):
    return Desk(graph, tmp_path)


def test_a_plan_runs_from_start_to_done(desk):
    count, first = len(PLAN.views), PLAN.views[0].name
    said = f"waiting for the plate to be placed: view 1 of {count} '{first}'"
    assert desk.ask("start").message == said
    expected = []
    for index in range(len(PLAN.views)):
        expected.append((PLACE, index))
        desk.expect(*expected)
        assert desk.ask("confirm_view").success
        expected.append((MEASURE, index))
        desk.expect(*expected)
        desk.complete(index, complete=False)
        desk.complete(index, plan_id="another plan")
        desk.complete(index + 1)
        desk.complete(index)
    desk.expect(*expected, (DONE, len(PLAN.views)))


def test_commands_carry_plan_plate_and_pose_with_growing_stamps(desk):
    desk.ask("start")
    desk.ask("confirm_view")
    desk.complete(0)
    desk.expect((PLACE, 0), (MEASURE, 0), (PLACE, 1))
    commands = [to_model.command(message) for message in desk.heard]
    stamps = [command.stamp_ns for command in commands]
    assert stamps == sorted(set(stamps))
    assert commands == [
        Command(
            stamp,
            phase,
            PLAN.plan_id,
            index,
            PLAN.views[index],
            PLAN.artifact,
            len(PLAN.views),
            str(stamps[0]),
        )
        for stamp, (phase, index) in zip(stamps, desk.commands, strict=True)
    ]


def test_redo_skip_and_abort(desk):
    desk.ask("start")
    desk.ask("confirm_view")
    assert desk.ask("redo_view").success
    second = f"view 2 of {len(PLAN.views)} '{PLAN.views[1].name}'"
    assert desk.ask("skip_view").message.endswith(
        f"{second}; view '{PLAN.views[0].name}' is left as it is"
    )
    assert desk.ask("abort").message == f"aborted: {second}"
    desk.expect((PLACE, 0), (MEASURE, 0), (PLACE, 0), (PLACE, 1), (ABORT, 1))
    assert desk.ask("start").success


@pytest.mark.parametrize(
    "service, problem",
    [
        ("confirm_view", "confirm_view does not fit while idle"),
        ("redo_view", "nothing to redo while idle"),
        ("skip_view", "nothing to skip while idle"),
        ("abort", "nothing to abort while idle"),
    ],
)
def test_a_request_that_does_not_fit_is_refused_and_changes_nothing(
    desk, service, problem
):
    answer = desk.ask(service)
    assert not answer.success
    assert problem in answer.message
    assert desk.ask("start").success
    desk.expect((PLACE, 0))


def test_without_a_plan_start_says_so(graph, tmp_path):
    answer = Desk(graph, tmp_path, plan="").ask("start")
    assert not answer.success
    assert (
        answer.message == "pose_sequencer: there is no plan; set the parameter 'plan'"
    )


def test_a_late_joiner_hears_the_newest_command_alone(desk):
    """An older one, a MEASURE of a run that was aborted, would set a cell off."""
    for request in ("start", "confirm_view", "abort"):
        assert desk.ask(request).success
    late = desk.graph.listen(names.COMMAND)
    desk.graph.until(lambda: late, "the latched command")
    assert desk.ask("start").success
    desk.graph.until(lambda: late[-1].phase == PLACE, "the next command")
    assert [message.phase for message in late] == [ABORT, PLACE]


def test_who_is_there_hears_every_command(desk):
    for _ in range(20):
        for request in ("start", "confirm_view", "redo_view", "abort"):
            assert desk.ask(request).success
    phases = [PLACE, MEASURE, PLACE, ABORT] * 20
    desk.graph.until(lambda: len(desk.heard) == len(phases), "the commands")
    assert [message.phase for message in desk.heard] == phases


def test_the_run_of_another_sequencer_wins_over_its_own(desk):
    desk.ask("start")
    desk.expect((PLACE, 0))
    begun = desk.graph.hand.get_clock().now().nanoseconds
    foreign = [
        Command(
            begun + 10 * number,
            phase,
            "other",
            index,
            PLAN.views[index],
            PLAN.artifact,
            run_id=str(begun),
        )
        for number, (index, phase) in enumerate(product((0, 1), (PLACE, MEASURE)))
    ]
    publisher = desk.graph.publisher(names.COMMAND, readers=2)
    for command in foreign:
        publisher.publish(
            fill(names.COMMAND.type(), from_model.command(command, "stage"))
        )
    desk.graph.until(lambda: len(desk.heard) >= 5, "the commands of the other")
    for service in ("start", "confirm_view", "skip_view"):
        answer = desk.ask(service)
        assert not answer.success
        assert "following recorded commands" in answer.message
    desk.complete(0)
    assert len(desk.commands) == 5
    assert desk.ask("abort").message.startswith("idle; what it followed is")
    assert desk.ask("start").success
    desk.graph.until(lambda: len(desk.heard) == 6, "a command of its own")


@pytest.mark.usefixtures("quick_beat")
def test_a_start_waits_for_who_is_missing_and_names_them(graph, tmp_path):
    desk = Desk(graph, tmp_path, start_checks=True)
    answer = desk.ask("start")
    assert answer.success
    assert answer.message == (
        "waiting for measurement_collector (no sign of life), solver (no sign of life); starts "
        "automatically when they are present"
    )
    heard: list = []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    for said, values in (
        (
            "waiting for the encoder (measurement_collector hears no sample), a publisher of "
            "stage/mark_detections",
            {"encoder_heard": "no", "detections_matched": "no"},
        ),
        (
            "waiting for a publisher of stage/mark_detections",
            {"encoder_heard": "yes", "detections_matched": "no"},
        ),
    ):
        graph.health("solver")
        graph.health("measurement_collector", **values)
        graph.until(
            lambda said=said: any(s.message == said for m in heard for s in m.status),
            said,
        )
    assert desk.commands == []
    all_alive(graph)
    desk.expect((PLACE, 0))


def test_a_start_that_waits_can_be_given_up(graph, tmp_path):
    desk = Desk(graph, tmp_path, start_checks=True)
    assert desk.ask("start").message.startswith("waiting for ")
    assert desk.ask("abort").message == "idle: no longer waiting"
    all_alive(graph)
    graph.until(lambda: not desk.node.session.missing(), "all of them")
    assert not desk.ask("confirm_view").success
    assert desk.commands == []


def test_an_automatic_start_waits_too(graph, tmp_path):
    desk = Desk(graph, tmp_path, auto_start=True, start_checks=True)
    graph.until(lambda: desk.node.session.waiting, "the node")
    assert desk.node.session.machine.state is State.IDLE
    all_alive(graph)
    desk.expect((PLACE, 0))


def test_a_restarted_sequencer_takes_up_the_run_in_its_view(graph, tmp_path):
    desk = Desk(graph, tmp_path, start_checks=True)
    told = {
        "plan_id": PLAN.plan_id,
        "run_id": "17",
        "phase": "MEASURE",
        "view": "1",
        "view_name": PLAN.views[1].name,
        "command_stamp": "1700",
    }
    all_alive(graph, **told)
    graph.until(lambda: not desk.node.session.missing(), "all of them")
    assert (
        desk.ask("start").message
        == f"resumed run 17 in view '{PLAN.views[1].name}', MEASURE"
    )
    desk.expect((MEASURE, 1))
    assert to_model.command(desk.heard[0]) == Command(
        1700,
        MEASURE,
        PLAN.plan_id,
        1,
        PLAN.views[1],
        PLAN.artifact,
        len(PLAN.views),
        "17",
    )
    desk.complete(1)
    desk.expect((MEASURE, 1), (PLACE, 2))
    assert desk.heard[1].run_id == "17"


def test_following_is_a_warning_only_where_a_plan_is_given_up(desk, monkeypatch):
    said = []
    monkeypatch.setattr(
        desk.node,
        "get_logger",
        lambda: SimpleNamespace(
            info=lambda text: said.append(("info", text)),
            warning=lambda text: said.append(("warning", text)),
        ),
    )
    for level in ("info", "warning"):
        stamp = desk.node.get_clock().now().nanoseconds
        message = fill(
            names.COMMAND.type(),
            from_model.command(
                Command(
                    stamp,
                    PLACE,
                    "other",
                    0,
                    PLAN.views[0],
                    PLAN.artifact,
                    run_id=str(stamp),
                ),
                "stage",
            ),
        )
        desk.node.session.take_command(message)
        desk.node.session.take_command(message)
        assert [item for item in said if item[1].startswith("another publisher")] == [
            (
                level,
                "another publisher sends view commands: following them; abort ends that",
            )
        ]
        assert desk.ask("abort").success
        assert desk.ask("start").success
        said.clear()


def test_an_incomplete_view_is_redone_and_then_skipped(graph, tmp_path, monkeypatch):
    monkeypatch.setattr(pose_sequencer, "TICK_S", 0.005)
    desk = Desk(
        graph,
        tmp_path,
        auto_start=True,
        auto_confirm=True,
        settle_time=0.0,
        view_timeout=0.02,
        max_redos=1,
    )
    twice = [
        (phase, index)
        for index in range(len(PLAN.views))
        for phase in (PLACE, MEASURE, PLACE, MEASURE)
    ]
    desk.expect(*twice, (DONE, len(PLAN.views)))


class Actor(Desk):
    """A desk with an action client, and a solver that only saves."""

    def __init__(self, graph: Graph, folder, **parameters) -> None:
        super().__init__(
            graph,
            folder,
            auto_confirm=True,
            settle_time=0.0,
            result_path=str(folder / "map.json"),
            **parameters,
        )
        self.saved, self.feedback = [], []
        self.answer = SaveMap.Response(
            success=True, message="saved", path=str(folder / "map.json")
        )
        graph.hand.create_service(SaveMap, "solver/save_map", self._save)
        self.client = ActionClient(
            graph.hand, RunCalibration, "pose_sequencer/run_calibration"
        )
        graph.until(self.client.server_is_ready, "the action server")

    def _save(self, request, response):
        self.saved.append(request.path)
        return self.answer

    def send(self, plan_path: str = ""):
        return self.graph.finish(
            self.client.send_goal_async(
                RunCalibration.Goal(plan_path=plan_path),
                feedback_callback=lambda m: self.feedback.append(m.feedback),
            ),
            "the goal's response",
        )

    def result(self, handle):
        answer = self.graph.finish(handle.get_result_async(), "the result")
        return answer.status, answer.result

    def measure_all(self) -> None:
        for index in range(len(PLAN.views)):
            self.graph.until(
                lambda index=index: (MEASURE, index) in self.commands, f"view {index}"
            )
            self.complete(index)


@pytest.fixture
def actor(graph, tmp_path):
    return Actor(graph, tmp_path)


def test_the_action_runs_the_plan_and_names_the_map(actor, tmp_path):
    handle = actor.send()
    assert handle.accepted
    actor.graph.until(lambda: (MEASURE, 0) in actor.commands, "the first view")
    actor.complete(0, complete=False)
    actor.graph.until(
        lambda: any(f.coverage == 0.2 for f in actor.feedback), "coverage"
    )
    actor.measure_all()
    status, result = actor.result(handle)
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert (result.error_code, result.map_path) == (0, str(tmp_path / "map.json"))
    assert actor.saved == [result.map_path]
    assert {f.view for f in actor.feedback} <= {view.name for view in PLAN.views}
    assert all(one != other for one, other in pairwise(actor.feedback))


def test_a_cancelled_goal_aborts_the_plan(actor):
    handle = actor.send(actor.plan)
    actor.graph.until(lambda: (MEASURE, 0) in actor.commands, "the first view")
    actor.graph.finish(handle.cancel_goal_async(), "the cancel response")
    status, result = actor.result(handle)
    assert status == GoalStatus.STATUS_CANCELED
    assert result.error_code == 4
    assert "not measured to its end: aborted" in result.message
    actor.graph.until(lambda: (ABORT, 0) in actor.commands, "the ABORT command")
    assert actor.saved == []


def test_a_second_goal_is_rejected_and_the_first_goes_on(actor):
    first = actor.send()
    assert not actor.send().accepted
    actor.measure_all()
    assert actor.result(first)[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_goal_is_rejected_while_the_node_is_not_active(actor, capfd):
    """Without a server nobody answered it until the node was active again."""
    for step in ("deactivate", "cleanup"):
        getattr(actor.node, f"trigger_{step}")()
    assert not actor.send().accepted
    said = "goal rejected while the node is unconfigured: activate it first"
    assert said in capfd.readouterr().err
    actor.node.trigger_configure()
    actor.node.trigger_activate()
    actor.node.trigger_deactivate()
    assert not actor.send().accepted
    assert (
        "goal rejected while the node is inactive: activate it first"
        in capfd.readouterr().err
    )
    actor.node.trigger_activate()
    first = actor.send()
    assert first.accepted
    actor.node.trigger_deactivate()  # the goal in execution goes on afterwards
    actor.node.trigger_activate()
    actor.measure_all()
    assert actor.result(first)[0] == GoalStatus.STATUS_SUCCEEDED


def test_of_two_goals_that_come_at_once_one_is_rejected(actor):
    """Both were accepted before one was executed, and the result of the first never came."""
    sent = [actor.client.send_goal_async(RunCalibration.Goal()) for _ in range(2)]
    handles = [actor.graph.finish(future, "the goal's response") for future in sent]
    assert sorted(handle.accepted for handle in handles) == [False, True]
    actor.measure_all()
    first = next(handle for handle in handles if handle.accepted)
    assert actor.result(first)[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_goal_after_a_goal(actor):
    for _ in range(2):
        actor.heard.clear()
        handle = actor.send()
        actor.measure_all()
        assert actor.result(handle)[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_plan_that_cannot_be_read_fails_with_code_2(actor, tmp_path):
    status, result = actor.result(actor.send(str(tmp_path / "no.yaml")))
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == 2
    assert result.message == f"{tmp_path}/no.yaml: no such file; check the path"
    assert actor.commands == []


def test_a_map_that_cannot_be_saved_fails_with_the_solvers_words(actor):
    actor.answer = SaveMap.Response(
        success=False, error_code=3, message="modes are unseen"
    )
    handle = actor.send()
    actor.measure_all()
    status, result = actor.result(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert (result.error_code, result.message, result.map_path) == (
        3,
        "modes are unseen",
        "",
    )


def test_a_result_has_code_0_only_if_it_is_done(actor):
    """That of a goal which is not known, too: rclpy answers with an empty result."""
    assert RunCalibration.Result().error_code == 1
    actor.answer = SaveMap.Response(success=False, message="no reason")
    handle = actor.send()
    actor.measure_all()
    status, result = actor.result(handle)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, 1)


class Hung:
    """A solver's service that does not answer."""

    def __init__(self) -> None:
        self.held: list[Future] = []

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request):
        self.held.append(Future())
        return self.held[-1]

    def remove_pending_request(self, future) -> None:
        assert future is self.held[-1]


def test_a_solver_that_does_not_answer_is_told_in_time(graph, tmp_path):
    actor = Actor(graph, tmp_path, save_timeout=0.1)
    actor.node._action._saver = Hung()
    handle = actor.send()
    actor.measure_all()
    status, result = actor.result(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert (result.error_code, result.map_path) == (4, "")
    assert result.message == (
        "run_calibration: the solver has not saved the map in 0.1 s; check the solver, "
        "then call save_map"
    )


@pytest.mark.parametrize(
    "undone",
    [
        ["deactivate", "cleanup"],
        ["shutdown"],
        ["deactivate", "cleanup", "configure", "activate"],
    ],
)
@pytest.mark.parametrize("saving", [False, True], ids=["measuring", "saving"])
def test_a_goal_ends_with_a_result_when_the_node_is_cleaned_up(actor, undone, saving):
    """Its client waited for ever."""
    hung = actor.node._action._saver = Hung()
    handle = actor.send()
    if saving:
        actor.measure_all()
        actor.graph.until(lambda: hung.held, "the request to save")
    else:
        actor.graph.until(lambda: (MEASURE, 0) in actor.commands, "the first view")
    for step in undone:
        getattr(actor.node, f"trigger_{step}")()
    status, result = actor.result(handle)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, 4)
    assert result.message == (
        "run_calibration: pose_sequencer was cleaned up before the map was saved; "
        + (
            "call solver/save_map"
            if saving
            else "activate it again: its service start resumes the plan"
        )
    )
    if "activate" in undone:
        actor.heard.clear()
        later = actor.send()
        actor.measure_all()
        assert actor.result(later)[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_status_of_before_the_command_does_not_complete_a_redone_view(desk):
    desk.ask("start")
    desk.ask("confirm_view")
    desk.ask("redo_view")
    desk.ask("confirm_view")
    desk.expect((PLACE, 0), (MEASURE, 0), (PLACE, 0), (MEASURE, 0))
    desk.complete(0, age_ns=1)
    desk.complete(0)
    desk.expect((PLACE, 0), (MEASURE, 0), (PLACE, 0), (MEASURE, 0), (PLACE, 1))

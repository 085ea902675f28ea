# SPDX-License-Identifier: Apache-2.0
"""The session of solver: readings solved together, results published and saved."""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from selfcal_ros.applications.papers.methods import calibrate_by
from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.collector import keep_freed_memory
from selfcal_ros.collection.inputs import (
    Phase,
    begun_ns,
    check_command,
    check_plate,
    check_view,
)
from selfcal_ros.collection.reduce import with_collected
from selfcal_ros.errors import (
    InputError,
    NoDataError,
    NotIdentifiableError,
    SelfcalError,
)
from selfcal_ros.estimation.api import Options, calibrate, calibrate_corrected
from selfcal_ros.model import result as results
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import without_cell
from selfcal_ros.model.readings import (
    GridVisits,
    Measurements,
    ViewReadings,
    session_digest,
    view_digest,
)
from selfcal_ros.model.view import View
from selfcal_ros.nodes.sessions.clocks import PlanRun, begins_in_future, supersedes
from selfcal_ros.nodes.sessions.compensating import (
    is_qualified,
    read_result,
    result_file,
    run_file,
)
from selfcal_ros.nodes.sessions.health import Diagnosis, Level, Ports
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.summary.numbers import counted, summary_numbers
from selfcal_ros.reporting.summary.sections import state_line
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.observability import with_advice
from selfcal_ros.reporting.words.verification import with_verification
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import SolverSettings
from selfcal_ros.topics import MEASUREMENT_TOPIC
from selfcal_ros.units import NS_PER_S

RETRY_S = 10.0
"""Time after which a result that could not be written is written again."""


@dataclass(frozen=True, eq=False)
class Job:
    """Readings to be solved, with their identification; passed to a worker."""

    run: PlanRun
    measurements: Measurements
    options: Options
    method: str
    digest: str
    stamp_ns: int
    notes: tuple[str, ...] = ()
    views_done: int = 0


@dataclass(frozen=True, eq=False)
class SolvingOutcome:
    """Outcome of a job; `problem` if the readings do not identify the stage, or worse."""

    job: Job
    result: results.CalibrationResult | None
    problem: Exception | None


def solve(job: Job) -> SolvingOutcome:
    """Solve a job; depends on nothing else, so it can run anywhere."""
    try:
        if job.measurements.verify:
            return SolvingOutcome(job, _verified(job), None)
        outcome = calibrate_by(job.method, job.measurements, job.options)
        return SolvingOutcome(job, _finished(job, outcome), None)
    except NotIdentifiableError as error:
        result = results.unidentified_result(job.measurements, error.observability)
        return SolvingOutcome(job, _finished(job, result), with_advice(error))
    except Exception as error:  # reported by `take`, in the thread of the session
        return SolvingOutcome(job, None, error)


def _verified(job: Job) -> results.CalibrationResult:
    """Return the map with the correction on, and what that shows, as `selfcal verify` does."""
    before = job.options.plate
    after = _finished(job, calibrate_corrected(job.measurements, job.options))
    return with_verification(
        cast(results.CalibrationResult, before),
        after,
        names=(job.options.plate_from, job.measurements.plan_id),
    )[0]


def _finished(job: Job, result: results.CalibrationResult) -> results.CalibrationResult:
    """Return the result of a job with everything that a result from the bag has."""
    result = worded(with_collected(result, job.measurements.views))
    return results.with_warnings(result, job.notes)


@cache
def warm_up(marks: int = 5) -> None:
    """Warm up the solver with noise; once per process.

    Otherwise the first solution of a session would be slow. Call it before other threads
    exist: threadpoolctl, when it first searches for libraries, waits for the interpreter while the
    library loader waits for it, and an import in another thread at that time is a deadlock.
    Then again in the solving thread, which has its own memory.

    Parameters
    ----------
    marks : int
        Marks per side of the plate, for which memory is prepared.
    """
    keep_freed_memory()
    calibrate(pure_noise(marks))


def pure_noise(marks: int) -> Measurements:
    """Return readings of noise in four views, to call `calibrate` with before there are others.

    Parameters
    ----------
    marks : int
        Marks along each side of the plate.
    """
    plate = Artifact(marks, 0.01, 8)
    rng = np.random.default_rng(1)
    lines = np.arange(plate.angular_count)
    views = []
    for number, view in enumerate(
        (
            View("identity"),
            View("rot90", np.pi / 2),
            View("line", np.pi / 4, grid=False),
            View("shift_x", 0.0, (plate.grid_pitch_m, 0.0)),
        )
    ):
        on_field = view.grid & (
            plate.m + bool(view.translation_m[0]) <= plate.limits[0][1]
        )
        m, n = plate.m[on_field], plate.n[on_field]
        dx, dy, offset_x, offset_y = rng.normal(0.0, 2e-8, (4, len(m)))
        once = np.ones(len(m), dtype=int)
        mark = np.arange(len(m))
        visits = GridVisits(
            mark=mark,
            dx=dx,
            dy=dy,
            count=once,
            stamp_ns=(1000 * number + mark) * NS_PER_S,
            offset_x=offset_x,
            offset_y=offset_y,
            approach_x=once,
            approach_y=once,
        )
        views.append(
            ViewReadings(
                view=view,
                m=m,
                n=n,
                dx=dx,
                dy=dy,
                count=once,
                k=lines,
                dtheta=rng.normal(0.0, 1e-6, len(lines)),
                count_theta=np.ones(len(lines), dtype=int),
                used=len(m) + len(lines),
                visits=visits if view.grid else None,
            )
        )
    return Measurements("noise", plate, tuple(views))


@dataclass
class Shown:
    """Present publication: a result and its run, or why there is none."""

    result: results.CalibrationResult | None = None
    problem: Exception | None = None
    run: PlanRun = field(default_factory=PlanRun)
    views_done: int = 0
    stamp_ns: int = 0
    digest: str = ""


class SolvingSession:
    """Create jobs when readings have arrived; publish ``map``, ``markers``, ``summary``.

    Readings of different runs are never solved together: the newest run counts, and later readings
    of an older one are ignored.

    Parameters
    ----------
    settings : SolverSettings
        Values of the solver's parameters.
    ports : Ports
        Publishes ``map``, ``summary`` and ``markers`` (the map and its stamp in ns).
    """

    def __init__(self, settings: SolverSettings, ports: Ports) -> None:
        self._settings, self._ports = settings, ports
        self._messages: dict[
            tuple[int, int, int], Any
        ] = {}  # by view, and cell of the image
        self._notes: tuple[str, ...] = ()  # on the session, from the newest message
        self._run = PlanRun()
        self._planned: dict[PlanRun, int] = {}
        self._ended: set[PlanRun] = set()  # DONE was received
        self._stale = False
        self._left_aside = 0
        self._saved = ""  # absolute path of the published map
        # results that could not be written, by their files; why, and when it was tried
        self._unwritten: dict[Path, results.CalibrationResult] = {}
        self._unsaved, self._tried_s = "", 0.0
        self.shown = Shown()

    @property
    def result(self) -> results.CalibrationResult | None:
        """The published result."""
        return self.shown.result

    @property
    def stale(self) -> bool:
        """Whether there are readings without a job."""
        return self._stale

    def take_command(self, message: Any) -> None:
        """Get the number of planned views from a view command.

        Raises
        ------
        InputError
            If the collector refuses it as well.
        """
        command = to_model.command(message)
        check_command(command)
        run = PlanRun(command.plan_id, command.run_id)
        n_planned = self._planned.get(run, 0)
        self._planned[run] = max(n_planned, command.views_planned)
        ends = command.phase == Phase.DONE and run not in self._ended
        if ends:
            self._ended.add(run)
        tells = not self._planned_views(run) or isinstance(
            self.shown.problem, NoDataError | NotIdentifiableError
        )
        if run in (self._run, PlanRun(self._run.plan_id)) and (
            command.views_planned > n_planned or (ends and tells)
        ):
            # the summary shows the number of planned or remaining views
            self._stale = True

    def _is_over(self, run: PlanRun) -> bool:
        """Return whether DONE was received; commands without a run end all of them."""
        return bool(self._ended & {run, PlanRun(run.plan_id)})

    def _planned_views(self, run: PlanRun) -> int:
        """Return the number of planned views; commands without a run count for all runs."""
        return max(
            self._planned.get(run, 0), self._planned.get(PlanRun(run.plan_id), 0)
        )

    def take_measurement(self, message: Any) -> None:
        """Take the readings of a view; those of an older run are ignored.

        Raises
        ------
        InputError
            If the message is inconsistent or impossible.
        """
        check_view(
            to_model.view_readings(message),
            to_model.artifact_of(message),
            int(message.view_index),
        )
        run = PlanRun(message.plan_id, message.run_id)
        now_ns = self._ports.now_ns()
        if begins_in_future(run, now_ns):
            raise InputError(
                MEASUREMENT_TOPIC,
                f"run {run.run_id} begins in the future of this node's clock",
                "set the clocks, and start the plan again",
            )
        if run != self._run:
            if self._messages and not (
                supersedes(run, self._run) or begins_in_future(self._run, now_ns)
            ):
                if begun_ns(run.run_id) is None:
                    raise InputError(
                        MEASUREMENT_TOPIC,
                        f"readings without a run_id, while run {self._run.run_id} is "
                        "known: not used",
                        "set run_id in the commands, or restart the solver",
                    )
                self._left_aside += 1
                return
            self._run, self._messages = run, {}
        # one collector, in order: its newest message on a view is valid
        cell = to_model.cell_of(message) or (0, 0)
        self._messages[message.view_index, *cell] = message
        self._notes = to_model.notes_of(message)
        self._stale = True

    def measurements(self) -> Measurements:
        """Return the readings of all views of the run so far."""
        if not self._messages:
            raise NoDataError(
                MEASUREMENT_TOPIC,
                "no view has been measured",
                "start the collector and measure",
            )
        ordered = [self._messages[index] for index in sorted(self._messages)]
        newest = max(ordered, key=lambda m: sum(m.session_reject_counts))
        artifacts = {to_model.artifact_of(message) for message in ordered}
        if len(artifacts) > 1:
            raise InputError(
                MEASUREMENT_TOPIC,
                "views of different plates in one plan",
                "measure one plate",
            )
        artifact = artifacts.pop()
        views = tuple(to_model.view_readings(message) for message in ordered)
        check_plate(artifact, views)
        return Measurements(
            ordered[0].plan_id,
            artifact,
            views,
            sense=to_model.sense_of(ordered[0]),
            rejected=to_model.counts(newest, "session_reject"),
            run_id=self._run.run_id,
            model_terms=to_model.terms_of(newest),
            artifact_from=to_model.plate_from(newest),
            **to_model.plan_keys_of(newest),
        )

    def _by_view(
        self, readings: Sequence[ViewReadings]
    ) -> dict[int, list[ViewReadings]]:
        """Return the readings, in the order of the messages, by their view in the plan."""
        views: dict[int, list[ViewReadings]] = {}
        for (index, *_), part in zip(sorted(self._messages), readings, strict=True):
            views.setdefault(index, []).append(part)
        return views

    @property
    def _views_done(self) -> int:
        return len({index for index, *_ in self._messages})

    @property
    def _incomplete(self) -> bool:
        """Whether cells of an image are still to come: they are sent one after the other."""
        cells = Counter(index for index, *_ in self._messages)
        return any(
            cells[index] < max(message.image_nx * message.image_ny, 1)
            for (index, *_), message in self._messages.items()
        )

    def next_job(self) -> Job | None:
        """Return the next job, if readings have arrived since the last one.

        Raises
        ------
        SelfcalError
            If the readings cannot be used together; also shown as the state.
        """
        if not self._stale or self._incomplete:
            return None
        self._stale = False
        if self._verifies_later():
            return None
        stamp = max(map(to_model.stamp_ns, self._messages.values()), default=0)
        try:
            measurements = self.measurements()
            digest = session_digest(
                {
                    index: view_digest(parts, measurements.rejected)
                    for index, parts in self._by_view(measurements.views).items()
                }
            )
            options = solver_options(self._settings, measurements)
        except SelfcalError as error:
            self.shown = Shown(None, error, self._run, self._views_done, stamp)
            self._publish_summary()
            raise
        return Job(
            self._run,
            measurements,
            options,
            self._settings.method,
            digest,
            stamp_ns=stamp,
            notes=self._notes,
            views_done=self._views_done,
        )

    def _verifies_later(self) -> bool:
        """Return whether views of a verification are to come: one says less than all."""
        newest = next(iter(self._messages.values()), None)
        if (
            newest is None
            or not to_model.plan_keys_of(newest)["verify"]
            or self._is_over(self._run)
            or (self._views_done >= self._planned_views(self._run))
        ):
            return False
        self.shown = Shown(
            None,
            NoDataError("the verification", "views are to come", "measure them"),
            self._run,
            self._views_done,
        )
        self._publish_summary()
        return True

    def take(self, outcome: SolvingOutcome) -> None:
        """Publish the outcome of a job, unless another run has begun meanwhile."""
        job = outcome.job
        if job.run != self._run:
            return
        self.shown = Shown(
            result=outcome.result,
            problem=outcome.problem,
            run=job.run,
            views_done=job.views_done,
            stamp_ns=job.stamp_ns,
            digest=job.digest,
        )
        if outcome.result is None:
            self._take_none(outcome.problem)
            return
        self._saved = ""
        self._publish(outcome.result)
        if self._settings.save_path and outcome.problem is None:
            path = run_file(self._settings.save_path, job.run.run_id)
            self._unwritten[path] = outcome.result
            self._save_by_itself()

    def _take_none(self, problem: Exception | None) -> None:
        """Publish why there is no result; raise it unless remaining views may change this."""
        self._publish_summary()
        if not self._unfinished():
            raise problem or ValueError("neither a result nor a problem")
        self._ports.say(Level.OK, self._state())

    def _save_by_itself(self) -> None:
        """Write the results that are not written, each to the file of its run."""
        problem = ""
        for path, result in [*self._unwritten.items()]:
            try:
                write_json(path, results.result_to_dict(results.created_now(result)))
            except InputError as error:
                # the map itself is good, and save_map may use another path
                self._tried_s = self._ports.now_s()
                if not (self._unsaved or problem):
                    self._ports.say(Level.ERROR, f"save_path: {error}")
                problem = f"the map is not saved: {error}"
                continue
            del self._unwritten[path]
            if result is self.shown.result:
                self._saved = str(path)
            if self._unsaved:
                self._ports.say(Level.OK, f"the map is saved now: {path}")
        self._unsaved = problem

    def save_again(self) -> None:
        """Write results that could not be written, some time after the last attempt."""
        if self._unwritten and self._ports.now_s() - self._tried_s >= RETRY_S:
            self._save_by_itself()

    def _publish(self, result: results.CalibrationResult) -> None:
        shown = self.shown
        of_stage = result.verification is None  # else of what a correction leaves
        is_map = shown.problem is None and of_stage
        if is_map:
            self._ports.publish(
                "map",
                from_model.error_map(result, shown.stamp_ns, self._settings.frame_id)
                | _verdict(shown),
            )
        self._publish_summary()
        if is_map:  # last, as pictures are slow
            self._ports.publish(
                "markers", {"error_map": result.error_map, "stamp_ns": shown.stamp_ns}
            )

    def _publish_summary(self) -> None:
        """Publish what is shown, also that there is no map: an earlier summary says otherwise."""
        shown = self.shown
        result = self.shown.result
        planned = self._planned_views(shown.run)
        advice = [f"{counted(planned - shown.views_done, 'view')} to come"]
        if not self._unfinished():
            advice = (
                [str(shown.problem)]
                if result is None
                else [advised.text for advised in result.observability.advice]
            )
        self._ports.publish(
            "summary",
            {
                "header": from_model.header(shown.stamp_ns, self._settings.frame_id),
                "state": self._state(),
                "views_done": shown.views_done,
                "views_planned": planned,
                "identifiable": result is not None
                and result.observability.identifiable,
                "rank_deficiency": 0
                if result is None
                else result.observability.deficiency,
                **summary_numbers(result),
                "advice": [*advice, *(result.warnings if result else ())],
                "causes": [cause.text for cause in result.verdict.causes]
                if result
                else [],
                **_verdict(shown),
            },
        )

    def _unfinished(self) -> bool:
        """Return whether remaining views may help.

        Lines without any grid mark are taken as a beginning until DONE: readings may arrive
        before any command, and shuffled ones may begin with the lines of each
        view.
        """
        run, problem = self.shown.run, self.shown.problem
        to_come = self.shown.views_done < self._planned_views(run)
        over = self._is_over(run)
        if isinstance(problem, NoDataError):
            return not over or to_come
        return isinstance(problem, NotIdentifiableError) and to_come and not over

    def _state(self) -> str:
        if self._unfinished():
            n_done = self.shown.views_done
            planned = self._planned_views(self.shown.run)
            views = (
                f"{n_done} of {planned} views measured"
                if planned
                else f"{counted(n_done, 'view')} measured so far"
            )
            return f"{views}, not yet enough to identify the stage."
        if self.shown.problem is not None or self.shown.result is None:
            return str(self.shown.problem)
        return state_line(self.shown.result)

    def digest(self) -> str:
        """Return the fingerprint of the readings behind what is shown; "" = none."""
        return "" if self._stale else self.shown.digest

    def save(self, path: str) -> tuple[str, str]:
        """Write the published result; return a line for the log, and the absolute path.

        A result without a map, of readings that do not identify the stage, is written as well, but
        replaces no file.

        Raises
        ------
        SelfcalError
            If there is no map, or `path` is outside the folder for results.
        """
        problem = self.shown.problem
        if self.shown.result is None:
            raise problem or NoDataError(
                "solver", "there is no map yet", "measure the views of the plan"
            )
        target = result_file(path, self._settings.result_folder)
        if problem is not None and os.path.exists(target):
            raise problem
        write_json(
            target, results.result_to_dict(results.created_now(self.shown.result))
        )
        if problem is not None:
            raise problem
        self._saved = str(target)
        self._unwritten = {
            file: result
            for file, result in self._unwritten.items()
            if result is not self.shown.result
        }
        self._unsaved *= bool(self._unwritten)
        run = self.shown.run
        named = f"plan '{run.plan_id}'" + (f", run {run.run_id}" if run.run_id else "")
        line = (
            f"saved to {target}: {named}; readings {self.digest() or 'of a loaded map'}"
        )
        verdict = self.shown.result.verdict
        doubts = [
            self._newer(self._planned),
            self._lacking(),
            "" if verdict.qualified else verdict.sentence,
        ]
        doubts += self.shown.result.warnings
        return "; WARNING: ".join([line, *filter(None, doubts)]), str(target)

    def _newer(self, runs: Iterable[PlanRun]) -> str:
        """Return a note on a run that is newer than the published one; "" if none."""
        now_ns = self._ports.now_ns()
        published_ns = begun_ns(self.shown.run.run_id)
        later = [
            (begun, run)
            for run in runs
            if (begun := begun_ns(run.run_id))
            and published_ns
            and begun > published_ns
            and not begins_in_future(run, now_ns)
        ]
        if not later:
            return ""
        run = max(later, key=lambda item: item[0])[1]
        return (
            f"the newer run {run.run_id} of plan '{run.plan_id}' is not in this map: none of "
            "its readings has arrived; the health of measurement_collector says why"
        )

    def _lacking(self) -> str:
        """Return a note on planned views that are not in the published map; "" if none."""
        n_done, n_planned = self.shown.views_done, self._planned_views(self.shown.run)
        is_loaded = not self.shown.digest
        if is_loaded or n_done >= n_planned:
            return ""
        return (
            f"{n_done} of {n_planned} views of the plan are in this map: the readings of the "
            "others have not arrived; measure them, or have measurement_collector send what it "
            "has (finish)"
        )

    def load(self, path: str) -> str:
        """Publish the map of a RESULT.json and log it."""
        result = read_result(path)
        self.shown = Shown(
            result,
            run=PlanRun(result.plan_id, result.run_id),
            views_done=len({without_cell(view.name) for view in result.views}),
        )
        self._saved = ""
        self._publish(result)
        return f"loaded {path}: plan {result.plan_id}"

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of the node."""
        shown = self.shown
        has_outcome = shown.result is not None or shown.problem is not None
        newer = self._newer(self._ended)  # a running one may still send its readings
        fine = (shown.problem is None or self._unfinished()) and (
            shown.problem is not None
            or shown.result is None
            or is_qualified(shown.result)
        )
        state = self._state() if has_outcome else "waiting for views"
        if shown.problem is not None and self._newer(self._planned):
            # of a run that ended early: nobody adds its views any more
            fine, state = True, f"the earlier run {shown.run.run_id}: {state}"
        wrong = [line for line in (self._unsaved, newer) if line]
        return Diagnosis(
            Level.OK if fine and not wrong else Level.WARN,
            "; ".join([*wrong, state]),
            {
                "views": self._views_done,
                "readings": self.digest(),
                "plan_id": self._run.plan_id,
                "run_id": self._run.run_id,
                "left_aside": self._left_aside,
                "saved": self._saved,
            },
        )


def _verdict(shown: Shown) -> dict[str, Any]:
    """Return the fields of a verdict that map and summary share; without a map it is not good."""
    result = shown.result
    return {
        "qualified": result is not None and is_qualified(result),
        "run_id": shown.run.run_id,
        "grade": 0 if result is None else from_model.grade_number(result),
    }

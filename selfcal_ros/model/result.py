# SPDX-License-Identifier: Apache-2.0
"""The result of a calibration and its JSON form, schema ``selfcal.result/1``."""

import hashlib
import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from selfcal_ros import __version__
from selfcal_ros.errors import InputError
from selfcal_ros.files import read
from selfcal_ros.model.artifact import Artifact, Interpolation
from selfcal_ros.model.budget import BudgetLine, budget_from_list, line_to_dict
from selfcal_ros.model.camera import (
    CameraErrors,
    StageYawMap,
    camera_to_dict,
    shown_by_images,
)
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.findings import (
    Finding,
    InWords,
    NotIdentified,
    finding_from_dict,
    finding_to_dict,
)
from selfcal_ros.model.kept import KEYS, Kept, kept_from_dict
from selfcal_ros.model.parts import PARTS, Parts
from selfcal_ros.model.plate_form import (
    artifact_of,
    artifact_to_dict,
    map_grid_from_dict,
    map_to_dict,
)
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.recheck import Recheck
from selfcal_ros.model.reference import (
    ReferenceLength,
    reference_from_dict,
    reference_to_dict,
)
from selfcal_ros.model.verdict import (
    Grade,
    ModelResult,
    Provenance,
    Verdict,
    provenance_from_dict,
    verdict_from_dict,
    verdict_to_dict,
)
from selfcal_ros.model.verified import Verified
from selfcal_ros.model.view import View, reads_between_nodes
from selfcal_ros.outputs import plain

SCHEMA = "selfcal.result/1"
VERIFICATION = "verification"
"""Part of a result that was measured with a correction on: what that showed."""
DIGEST = "digest"
"""Key of the digests of the other keys."""
WITHOUT_DIGESTS = re.compile(r"(0\.[0-3]\..*)?")
"""Versions that wrote no digests; the first results had no version."""
COMBINED = "combined"
"""Method of a mean of several results, and key of the runs behind it."""
LARGEST = 1e3
"""Larger errors and uncertainties, in m or rad, are invalid: sums of their squares overflow."""


@dataclass(frozen=True)
class ViewResult:
    """Result of one view: nominal pose, misalignment, detections used and rejected.

    Lengths in m, angles in rad, stage frame. `phi` is the rotation about the plate centre,
    `tx`, `ty` the offset; NaN if the view was not measured. `read_grid` and `read_angular` are
    the weights of the readings: one number if it is the same for all marks in the field (all
    lines), else a number per mark, [i][j], and per line; 0 = not read, None = unknown.
    """

    name: str
    rotation: float
    translation_x: float
    translation_y: float
    phi: float
    tx: float
    ty: float
    used: int = 0
    rejected: int = 0
    read_grid: Any = None
    read_angular: Any = None


@dataclass(frozen=True, eq=False)
class ArtifactMap:
    """Plate error A = true - nominal, plate frame: ax, ay (nx, ny) in m, a_theta (K,) in rad.

    `u_ax`, `u_ay`, `u_a_theta` are their standard uncertainties, NaN where unknown or not
    computed; empty in results that do not have them.
    `magnification` is by how much the encoders indicate the plate larger than nominal, with its
    standard uncertainty: the least-squares scale of A where no reference length sets another.
    """

    ax: np.ndarray
    ay: np.ndarray
    a_theta: np.ndarray
    magnification: float = math.nan
    u_magnification: float = math.nan
    u_ax: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    u_ay: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    u_a_theta: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Observability:
    """Observability from the marks that were read.

    Attributes
    ----------
    rank, unknowns : int
        Rank of the grid readings with the 7 datum rows, and number of unknowns (Qiao).
    deficiency : int
        Unseen modes in XY and theta together; 0 means identifiable.
    identifiable : bool
        Whether the stage error is determined.
    modes : tuple of Finding
        The unseen modes.
    advice : tuple of Finding
        Views or marks that would cure a deficiency.
    unchecked_sites, unchecked_lines : int, optional
        Number of sites and lines of the map that depend on single readings, which no other reading
        checks; None if not counted.
    """

    rank: int
    unknowns: int
    deficiency: int
    identifiable: bool
    modes: tuple[Finding, ...] = ()
    advice: tuple[Finding, ...] = ()
    unchecked_sites: int | None = None
    unchecked_lines: int | None = None


@dataclass(frozen=True)
class Noise:
    """Standard deviation of one reading, pooled over views: m and rad, NaN where unknown.

    `sigma_xy`, `sigma_theta` are the values behind the uncertainties; `*_repeats` come from the
    scatter of repeats, `*_residuals` from the residuals of the fit, `*_declared` from the
    detections; `dof_*` are their degrees of freedom, `dof_xy`, `dof_theta` those of the values
    used (NaN: unknown; infinite: declared). `dof_map_*` are those of the map's uncertainty at its
    nodes, which contains more than noise (Welch-Satterthwaite), and `k_*` the corresponding
    coverage factors for 95.45 %. `p_*` is the probability of such a difference of residuals and
    repeats, or declaration, by chance.
    """

    sigma_xy: float
    sigma_theta: float
    sigma_xy_repeats: float = float("nan")
    sigma_theta_repeats: float = float("nan")
    sigma_xy_residuals: float = float("nan")
    sigma_theta_residuals: float = float("nan")
    dof_xy_repeats: float = 0
    dof_theta_repeats: float = 0
    dof_xy_residuals: float = 0
    dof_theta_residuals: float = 0
    sigma_xy_declared: float = float("nan")
    sigma_theta_declared: float = float("nan")
    dof_xy: float = float("nan")
    dof_theta: float = float("nan")
    k_xy: float = 2.0
    k_theta: float = 2.0
    p_xy: float = float("nan")
    p_theta: float = float("nan")
    dof_map_xy: float = float("nan")
    dof_map_theta: float = float("nan")

    def dof_of(self, kind: str) -> float:
        """Return the degrees of freedom of the map's uncertainty, ``xy`` or ``theta``.

        Where they are not known, those of the noise alone.
        """
        map_dof = float(getattr(self, f"dof_map_{kind}"))
        return map_dof if map_dof > 0 else float(getattr(self, f"dof_{kind}"))


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The result of a calibration.

    `kept` is what the covariances of the maps follow from, `parts` what not every run has, `extra`
    keys of another program. `recheck` is
    what views of a known plate show to have changed; None of a calibration. `verification` is what
    a correction did that was on, None without one. `camera` and `stage_yaw` are what images of
    several marks show, None without.
    `findings` are the data of warnings; `warnings` are their sentences, added by
    `selfcal_ros.reporting.words.findings.worded`, and those of the collection. `read_from` is the
    name of the file and its SHA-256, of a result that was read from one.
    """

    plan_id: str
    error_map: ErrorMap
    artifact_map: ArtifactMap
    views: tuple[ViewResult, ...]
    observability: Observability
    noise: Noise
    rejected: dict[str, int] = field(default_factory=dict)
    input: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    method: str = "joint"
    sense: str = "microscope_moves"
    parts: Parts = Parts()
    extra: dict[str, Any] = field(default_factory=dict)
    kept: Kept = Kept()
    verdict: Verdict = Verdict(Grade.GOOD)
    model: ModelResult = ModelResult()
    reference: ReferenceLength | None = None
    provenance: Provenance = Provenance()
    run_id: str = ""
    findings: tuple[Finding, ...] = ()
    budget: tuple[BudgetLine, ...] = ()
    placed_plate: Artifact | None = None
    recheck: Recheck | None = None
    verification: Verified | None = None
    camera: CameraErrors | None = None
    stage_yaw: StageYawMap | None = None
    read_from: tuple[str, str] | None = None

    @property
    def artifact(self) -> Artifact:
        """Lattice of the error map: that of the plate unless the map has a grid of its own."""
        return self.error_map.artifact

    @property
    def plate(self) -> Artifact:
        """The plate, with the grid of the map if that has its own."""
        return self.placed_plate or self.error_map.artifact

    @property
    def interpolation(self) -> str:
        """Interpolation between the nodes of the map; empty if they are the plate's sites."""
        grid = self.plate.map_grid
        return "" if grid is None else str(grid.interpolation)

    @property
    def reads_between_nodes(self) -> bool:
        """Whether the readings show what the map lacks between its nodes; False if unknown."""
        views = (
            View(v.name, v.rotation, (v.translation_x, v.translation_y), angular=False)
            for v in self.views
            if v.read_grid is None or np.any(v.read_grid)
        )
        return reads_between_nodes(views, self.plate)

    @property
    def is_fitted_between_nodes(self) -> bool:
        """Whether u of the nodes contains what the map lacks between them, as it is used.

        A spline needs all of its nodes: with an unknown one the map is used linearly.
        """
        used_as_fitted = self.interpolation == Interpolation.BILINEAR or (
            self.interpolation == Interpolation.BICUBIC
            and bool(self.error_map.valid.all())
        )
        return used_as_fitted and self.reads_between_nodes

    @property
    def has_uncertainty(self) -> bool:
        """Whether the uncertainty of the XY map was computed."""
        emap = self.error_map
        return bool((np.isfinite(emap.u_gx) & np.isfinite(emap.u_gy)).any())


def with_input(
    result: CalibrationResult, source: dict[str, str], lost: list[str]
) -> CalibrationResult:
    """Return `result` with its input file, and losses in the file as warnings."""
    return replace(with_warnings(result, lost), input=source)


def with_warnings(result: CalibrationResult, lines: Iterable[str]) -> CalibrationResult:
    """Return `result` with further warnings."""
    return replace(result, warnings=(*result.warnings, *lines))


def created_now(result: CalibrationResult) -> CalibrationResult:
    """Return `result` with the present time as its time of creation, UTC."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return replace(result, provenance=replace(result.provenance, created=now))


def unidentified_result(
    measurements: Measurements, observability: Observability
) -> CalibrationResult:
    """Return the result of a plan that does not identify the stage, with unknown maps."""
    artifact = measurements.artifact
    grid = np.full(artifact.field.shape, np.nan)
    circle = np.full(artifact.angular_count, np.nan)
    plate = np.full(artifact.shape, np.nan)
    nan = math.nan
    views = tuple(
        ViewResult(
            v.view.name,
            v.view.rotation_rad,
            *v.view.translation_m,
            phi=nan,
            tx=nan,
            ty=nan,
            used=v.used,
            rejected=sum(v.rejected.values()),
        )
        for v in measurements.views
    )
    return CalibrationResult(
        plan_id=measurements.plan_id,
        error_map=ErrorMap(
            artifact=artifact.field,
            gx=grid,
            gy=grid,
            u_gx=grid,
            u_gy=grid,
            g_theta=circle,
            u_g_theta=circle,
            nonorthogonality=nan,
            scale_difference=nan,
        ),
        artifact_map=ArtifactMap(plate, plate, circle),
        views=views,
        observability=observability,
        noise=Noise(nan, nan),
        rejected=measurements.all_rejected(),
        sense=str(measurements.sense),
        verdict=Verdict(Grade.NOT_QUALIFIED, (NotIdentified(),)),
        provenance=Provenance(version=__version__),
        run_id=measurements.run_id,
        placed_plate=artifact.placed,
    )


def result_to_dict(result: CalibrationResult) -> dict[str, Any]:
    """Return the JSON form of a result; NaN becomes null.

    Its last key, ``digest``, is that of `digests_of`.

    Raises
    ------
    ValueError
        If it has no sentences: call `selfcal_ros.reporting.words.findings.worded` first.
    """
    emap, amap, artifact = result.error_map, result.artifact_map, result.plate
    provenance = result.provenance
    data = {
        "schema": SCHEMA,
        "plan_id": result.plan_id,
        "method": result.method,
        "measurement_sense": result.sense,
        "artifact": {
            **artifact_to_dict(artifact),
            **plain(
                {
                    key: getattr(amap, key)
                    for key in ("magnification", "u_magnification")
                }
            ),
        },
        **({"map": map_fields} if (map_fields := map_to_dict(artifact)) else {}),
        "run_id": result.run_id,
        "verdict": plain(verdict_to_dict(result.verdict)),
        "model": plain(result.model),
        "reference": plain(reference_to_dict(result.reference)),
        "provenance": plain(
            {
                "created": provenance.created,
                "duration_s": provenance.duration_s,
                "version": provenance.version,
                **provenance.facts,
            }
        ),
        "dof": plain({kind: result.noise.dof_of(kind) for kind in ("xy", "theta")}),
        "coverage_factor": plain(
            {kind: getattr(result.noise, f"k_{kind}") for kind in ("xy", "theta")}
        ),
        "views": list(map(_view_to_dict, result.views)),
        "error_map": plain(
            {
                **{key: getattr(emap, key) for key in _MAP_ARRAYS},
                "nonorthogonality": emap.nonorthogonality,
                "scale_difference": emap.scale_difference,
                "datum_theta": str(emap.datum_theta),
            }
        ),
        "artifact_map": plain({key: getattr(amap, key) for key in _PLATE_ARRAYS}),
        "observability": _seen_to_dict(result.observability),
        "noise": plain(result.noise),
        "rejected": dict(result.rejected),
        "warnings": list(result.warnings),
        "findings": plain([finding_to_dict(finding) for finding in result.findings]),
        "budget": plain([line_to_dict(line) for line in result.budget]),
        "input": dict(result.input),
        **({} if result.recheck is None else {"recheck": result.recheck.to_dict()}),
        **(
            {"camera": camera_fields}
            if (camera_fields := camera_to_dict(result.camera, result.stage_yaw))
            else {}
        ),
        **result.kept.to_dict(),
        **(
            {}
            if result.verification is None
            else {VERIFICATION: plain(result.verification)}
        ),
        **result.parts.to_dict(),
        **{key: plain(value) for key, value in result.extra.items()},
    }
    return with_digests(data)


def _view_to_dict(v: ViewResult) -> dict[str, Any]:
    return {
        "name": v.name,
        "rotation": v.rotation,
        "translation_x": v.translation_x,
        "translation_y": v.translation_y,
        "misalignment": plain({key: getattr(v, key) for key in ("phi", "tx", "ty")}),
        "used": v.used,
        "rejected": v.rejected,
        "read": plain({"grid": v.read_grid, "angular": v.read_angular}),
    }


def with_digests(data: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON form with the digests of its keys, last."""
    data = {key: value for key, value in data.items() if key != DIGEST}
    return {**data, DIGEST: digests_of(data)}


def digests_of(data: dict[str, Any]) -> dict[str, str]:
    """Return the digest of each key of a JSON form: the first 64 bits of the SHA-256 of its value.

    The time of creation counts for nothing: a solution of the same readings has the same digests.
    """
    provenance = dict(data.get("provenance") or {})
    provenance.pop("created", None)
    digests = {}
    for key, value in {**data, "provenance": provenance}.items():
        text = json.dumps(value, sort_keys=True, separators=(",", ":"))
        digests[key] = hashlib.sha256(text.encode()).hexdigest()[:16]
    digests.pop(DIGEST, None)
    return digests


def require_unchanged(data: dict[str, Any], where: str) -> bool:
    """Refuse a JSON form that was changed after it was written.

    Returns
    -------
    bool
        Whether it could be checked: not if it is of a version that wrote no digests.

    Raises
    ------
    InputError
        If the digests are missing, or a key does not have its own; the message names the key.
    """
    now = digests_of(data)
    written = data.get(DIGEST)
    version = (data.get("provenance") or {}).get("version") or ""
    if written is None and WITHOUT_DIGESTS.fullmatch(str(version)):
        return False
    remedy = "write it again with the verb that made it, such as `selfcal solve`"
    if not isinstance(written, dict):
        raise InputError(
            where, f"its {DIGEST!r} was removed after the file was written", remedy
        )
    for key in (*now, *written):
        if now.get(key) != written.get(key):
            raise InputError(
                where, f"its {key!r} was changed after the file was written", remedy
            )
    return True


_MAP_ARRAYS = ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta")
_PLATE_ARRAYS = ("ax", "ay", "a_theta", "u_ax", "u_ay", "u_a_theta")
_KNOWN = {
    "schema",
    "run_id",
    "verdict",
    "model",
    "reference",
    "provenance",
    "dof",
    "coverage_factor",
    "plan_id",
    "method",
    "measurement_sense",
    "artifact",
    "views",
    "error_map",
    "artifact_map",
    "observability",
    "noise",
    "rejected",
    "warnings",
    "findings",
    "budget",
    "excluded",
    "input",
    "map",
    "recheck",
    "camera",
    VERIFICATION,
    DIGEST,
    *KEYS,
    *PARTS,
}


def result_from_dict(data: object, where: str) -> CalibrationResult:
    """Return the result from its JSON form `data`, read from the file `where`.

    Raises
    ------
    InputError
        If the schema differs, or a key is missing or has the wrong shape.
    """
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(
            where,
            f"not a result of schema {SCHEMA}",
            "give a RESULT.json that `selfcal solve` wrote",
        )
    try:
        return _parse(data)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = (
            f"the key {error} is missing" if isinstance(error, KeyError) else str(error)
        )
        raise InputError(
            where, f"damaged result ({reason})", "write it again with `selfcal solve`"
        ) from error


def _parse(data: dict) -> CalibrationResult:
    artifact = _artifact(data["artifact"], data.get("map", {}))
    error_map = _error_map(data["error_map"], artifact)
    observability = _seen_from_dict(read(dict, data["observability"]))
    camera, stage_yaw = shown_by_images(data.get("camera"))
    return CalibrationResult(
        read(str, data["plan_id"]),
        error_map,
        _plate(data["artifact_map"], artifact, data["artifact"]),
        views=tuple(map(_view, data["views"])),
        observability=observability,
        noise=read(Noise, data["noise"]),
        rejected={key: read(int, value) for key, value in data["rejected"].items()},
        input={key: read(str, value) for key, value in data["input"].items()},
        warnings=read(tuple[str, ...], data.get("warnings", [])),
        method=read(str, data.get("method", "joint")),
        sense=str(read(Sense, data.get("measurement_sense", "microscope_moves"))),
        parts=read(Parts, data),
        extra={key: value for key, value in data.items() if key not in _KNOWN},
        kept=kept_from_dict(
            data, artifact.field.shape, artifact.shape, artifact.angular_count
        ),
        verdict=verdict_from_dict(
            data.get("verdict"), identifiable=observability.identifiable
        ),
        model=read(ModelResult, data.get("model") or {}),
        reference=reference_from_dict(data.get("reference")),
        provenance=provenance_from_dict(data.get("provenance")),
        run_id=read(str, data.get("run_id", "")),
        findings=tuple(map(finding_from_dict, read(list, data.get("findings", [])))),
        budget=budget_from_list(data.get("budget", [])),
        placed_plate=artifact if artifact.map_grid else None,
        recheck=read(Recheck | None, data.get("recheck")),
        verification=read(Verified | None, data.get(VERIFICATION)),
        camera=camera,
        stage_yaw=stage_yaw,
    )


def _artifact(raw: dict, grid: dict) -> Artifact:
    """Return the plate with the nodes of the map."""
    harmonics = read(int, grid.get("harmonics", 0))
    artifact = (
        Artifact(
            raw["grid_size"],
            float(raw["grid_pitch"]),
            raw["angular_count"],
            raw.get("grid_size_y", 0),
        )
        if "marks" not in raw
        else artifact_of(
            {key: raw[key] for key in ("marks", "angular_count")}, "artifact"
        )
    )
    return replace(artifact, map_grid=map_grid_from_dict(grid), harmonics=harmonics)


def _error_map(emap: dict, artifact: Artifact) -> ErrorMap:
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
        _MAP_ARRAYS[:4], artifact.field.shape
    )
    shapes |= dict.fromkeys(_MAP_ARRAYS[4:], (artifact.angular_count,))
    return ErrorMap(
        artifact.field,
        **{key: _array(emap[key], shape, key) for key, shape in shapes.items()},
        nonorthogonality=read(float, emap["nonorthogonality"]),
        scale_difference=read(float, emap["scale_difference"]),
        datum_theta=ThetaDatum(emap["datum_theta"]),
    )


def _plate(amap: dict, artifact: Artifact, raw: dict) -> ArtifactMap:
    shapes = dict.fromkeys(
        ("ax", "ay", "u_ax", "u_ay"), artifact.shape
    ) | dict.fromkeys(("a_theta", "u_a_theta"), (artifact.angular_count,))
    return ArtifactMap(
        **{
            key: _array(amap[key], shape, key)
            for key, shape in shapes.items()
            if key in ("ax", "ay", "a_theta") or amap.get(key)
        },
        magnification=read(float, raw.get("magnification")),
        u_magnification=read(float, raw.get("u_magnification")),
    )


def _view(v: dict) -> ViewResult:
    turn, x, y = (
        read(float, v[key]) for key in ("rotation", "translation_x", "translation_y")
    )
    if not np.isfinite([turn, x, y]).all():
        raise ValueError(f"the pose of view {v['name']!r} is not finite")
    phi, tx, ty = (read(float, v["misalignment"][key]) for key in ("phi", "tx", "ty"))
    return ViewResult(
        name=read(str, v["name"]),
        rotation=turn,
        translation_x=x,
        translation_y=y,
        phi=phi,
        tx=tx,
        ty=ty,
        used=read(int, v["used"]),
        rejected=read(int, v["rejected"]),
        read_grid=v.get("read", {}).get("grid"),
        read_angular=v.get("read", {}).get("angular"),
    )


def _seen_to_dict(observability: Observability) -> dict[str, Any]:
    """Return the JSON form of an observability: modes and advice in words."""
    words = {
        "modes": [finding.text for finding in observability.modes],
        "advice": [finding.text for finding in observability.advice],
    }
    return plain(replace(observability, modes=(), advice=())) | words


def _seen_from_dict(data: dict[str, Any]) -> Observability:
    words = {
        name: tuple(
            InWords(text=text) for text in read(tuple[str, ...], data.get(name, []))
        )
        for name in ("modes", "advice")
    }
    return replace(read(Observability, data | {"modes": [], "advice": []}), **words)


def _array(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    array = np.array(value, dtype=float)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}, not {shape}")
    if (np.abs(array) > LARGEST).any():
        raise ValueError(f"{name} has values beyond {LARGEST:g}")
    return array

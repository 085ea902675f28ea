# SPDX-License-Identifier: Apache-2.0
"""Runs of a plan: which readings belong together, and which run is the newer one."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Run:
    """One run of a plan; `run_id` is the stamp of its first command, ns, as text.

    `run_id` is empty where a publisher or a recording does not tell it.
    """

    plan_id: str = ""
    run_id: str = ""


def supersedes(new: Run, current: Run) -> bool:
    """Return whether what belongs to `new` takes the place of what belongs to `current`.

    The later run does. Where one of them does not tell its beginning, the one that came last.
    """
    begun, before = _begun_ns(new), _begun_ns(current)
    return begun is None or before is None or begun > before


def _begun_ns(run: Run) -> int | None:
    text = run.run_id
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 20 else None

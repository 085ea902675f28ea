# SPDX-License-Identifier: Apache-2.0
"""Readings that do not identify the stage, refused in the words that a user reads."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.model.findings import Finding
from selfcal_ros.reporting.words.observability import with_advice, worded


@contextmanager
def refused(match: str) -> Iterator[pytest.ExceptionInfo[NotIdentifiableError]]:
    """Require that readings are refused, with a match in the line that is shown."""
    with pytest.raises(NotIdentifiableError) as caught:
        yield caught
    assert re.search(match, str(with_advice(caught.value)))


def in_words(findings: tuple[Finding, ...]) -> list[str]:
    """Return unseen modes or advice as sentences."""
    return [worded(found).text for found in findings]

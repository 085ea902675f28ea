# SPDX-License-Identifier: Apache-2.0
"""Verbs called in a test's folder."""

import pytest

from selfcal_ros.cli.main import main


@pytest.fixture
def said(folder, monkeypatch, capsys):
    """Return a call of a verb in the module's folder: its output, and its code, 0 unless given."""
    monkeypatch.chdir(folder)

    def call(*words: str, code: int = 0) -> str:
        assert main(list(words)) == code
        return "".join(capsys.readouterr())

    return call

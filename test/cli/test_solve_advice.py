# SPDX-License-Identifier: Apache-2.0
"""``selfcal solve`` says in one line what mends detections that nothing identifies."""

from dataclasses import replace

from selfcal_ros.cli.main import main
from selfcal_ros.collection.messages import Detection
from test.support.bags import Foreign
from test.support.plans import plan_of
from test.support.sessions import events_of


def test_lines_that_cannot_be_told_apart_are_said_with_their_mend(tmp_path, capsys):
    events = [replace(e, has_id=False) if isinstance(e, Detection) else e
              for e in events_of(plan_of("0, 90, tx", 5, count=96, line=True))]
    path = Foreign().write(tmp_path / "x.mcap", events)
    code = main(["solve", str(path), "--quiet"])
    first, *rest = capsys.readouterr().err.splitlines()
    finding = "96 of 96 detections were rejected as rotation_not_known: the view's rotation is not"
    assert first.startswith(f"selfcal solve: {path}: view 'line': {finding}")
    assert code == 3 and len(rest) == 1  # the view of lines alone is what identifies theta
    assert rest[0].startswith(f"selfcal solve: {path}: view 'line': {finding}")
    mended = tmp_path / "p.yaml"
    mended.write_text("measurement_collector: {ros__parameters: {max_rotation: 0.02}}\n")
    assert main(["solve", str(path), "--quiet", "--params", str(mended)]) == 0
    assert capsys.readouterr().err == ""

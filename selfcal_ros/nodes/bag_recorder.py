# SPDX-License-Identifier: Apache-2.0
"""bag_recorder: writes the topics of this package as a rosbag2 MCAP bag."""

import sys
from functools import partial
from pathlib import Path
from typing import Any

from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode
from selfcal_ros.nodes.names import MatchedInput, kept_names, offered
from selfcal_ros.nodes.running import run
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.settings.nodes import RecorderSettings


class BagRecorder(SelfcalNode[RecorderSettings]):
    """Record messages as received; the bag survives a crash."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(RecorderSettings, **kwargs)
        if not self.settings.bag:
            raise InputError(
                "bag_recorder", "no bag is named", "set the parameter 'bag'"
            )
        self._writer = BagWriter(Path(self.settings.bag))
        topics = [*names.INPUTS, *(names.RESULTS if self.settings.all_topics else ())]
        for topic in topics:
            name, heard = kept_names(self, topic)
            self._writer.add_topic(name, topic.type_name, [offered(topic)], heard)
            if topic is not names.ENCODER:
                self.subscribe(topic, partial(self._record, name), raw=True)
        MatchedInput(
            self,
            names.ENCODER_EITHER,
            partial(self._record, kept_names(self, names.ENCODER)[0]),
            raw=True,
        )
        self._failed, self._unrecorded = "", 0
        self.exit_code = ExitCode.DONE
        self.every(1.0, self._flush)

    def _record(self, topic: str, data: bytes) -> None:
        if self._failed:
            self._unrecorded += 1
            return
        try:
            self._writer.write_raw(
                topic, bytes(data), self.get_clock().now().nanoseconds
            )
        except InputError as error:
            self._fail(error)

    def _fail(self, error: InputError) -> None:
        """Stop recording: after an incomplete write, later messages could not be read."""
        self._failed, self._unrecorded = str(error), self._unrecorded + 1
        self.exit_code = error.exit_code
        self.say(
            Level.ERROR,
            f"recording has ended: {error}; what was recorded is readable, start "
            "again in another folder",
        )

    def _flush(self) -> None:
        if not self._failed:
            try:
                self._writer.flush()
            except InputError as error:
                self._fail(error)

    def diagnosis(self) -> Diagnosis:
        """Return the number of recorded messages, or why recording has ended."""
        if self._failed:
            return Diagnosis(
                Level.ERROR,
                f"recording has ended: {self._failed}",
                self._writer.counts | {"unrecorded": self._unrecorded},
            )
        return Diagnosis(Level.OK, "recording", self._writer.counts)

    def close(self) -> None:
        """Finish the bag."""
        try:
            self._writer.close()
            self.say(Level.OK, f"{self.settings.bag}: {self._writer.counts}")
        except InputError as error:
            if not self._failed:
                self._fail(error)


def main() -> None:
    """Run the node."""
    sys.exit(run(BagRecorder))


if __name__ == "__main__":
    main()

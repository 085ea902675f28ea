# SPDX-License-Identifier: Apache-2.0
"""The session of mark_detector: what its health says."""

from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.nodes.sessions.detecting import MANY_EMPTY, DetectingSession
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.simulation.rendering import Camera
from selfcal_ros.vision import exposures

CAMERA = Camera(width=90, height=80)


@pytest.fixture
def desk():
    sent = []
    ports = SimpleNamespace(
        publish=lambda output, fields: sent.append((output, fields))
    )
    session = DetectingSession(
        DetectorSettings(pixel_size=2e-6, mark_size=5e-5, frame_id="f"), ports
    )
    return SimpleNamespace(session=session, sent=sent)


def image(stamp, values, camera="eye"):
    header = SimpleNamespace(
        stamp=SimpleNamespace(sec=stamp, nanosec=5), frame_id=camera
    )
    return SimpleNamespace(
        header=header,
        height=values.shape[0],
        width=values.shape[1],
        encoding="mono8",
        is_bigendian=0,
        step=values.shape[1],
        data=values.tobytes(),
    )


def drawn(marks=1):
    return CAMERA.image(np.zeros((2, marks)), np.random.default_rng(1))


def test_it_waits_for_an_image(desk):
    assert desk.session.diagnosis().message == "no image yet"
    assert desk.session.diagnosis().level == Level.WARN


def test_detections_have_frame_and_stamp_of_their_image(desk):
    desk.session.take(image(3, drawn()))
    [(output, fields)] = desk.sent
    assert output == "detection"
    assert fields["header"] == {"stamp": {"sec": 3, "nanosec": 5}, "frame_id": "f"}
    found = desk.session.diagnosis()
    assert (found.level, found.message) == (Level.OK, "1 mark in 1 image")
    assert float(found.values["ms_per_image_max"]) > 0
    # since the last one
    assert "ms_per_image_max" not in desk.session.diagnosis().values


@pytest.mark.parametrize(
    "values, why",
    [
        (
            drawn(0),
            "nothing looks like one: check mark, mark_size, pixel_size and polarity",
        ),
        (drawn()[25:], "most rejected as cut_off"),
        (
            np.where(drawn() > 100, 255, drawn()),
            "most rejected as saturated: expose shorter, and take the images again",
        ),
    ],
)
def test_images_without_marks_are_a_warning_with_its_likely_reason(desk, values, why):
    for number in range(MANY_EMPTY):
        assert (
            desk.session.diagnosis().message
            != f"no mark in the last {number} images, {why}"
        )
        desk.session.take(image(number + 1, values))
    found = desk.session.diagnosis()
    assert (found.level, found.message) == (
        Level.WARN,
        f"no mark in the last {MANY_EMPTY} images, {why}",
    )
    assert not desk.sent


def test_a_refused_image_is_counted(desk):
    desk.session.take(image(3, drawn()))
    with pytest.raises(InputError, match="stamp is that of an earlier image"):
        desk.session.take(image(3, drawn()))
    assert desk.session.diagnosis().values["images_refused"] == 1
    assert len(desk.sent) == 1


def refused(desk, images):
    """Return which images are refused, by their numbers."""
    out = []
    for number, each in enumerate(images):
        try:
            desk.session.take(each)
        except InputError:
            out.append(number)
    return out


def test_a_stamp_in_the_future_or_a_clock_set_back_costs_no_other_image(desk):
    stamps = [100, 101, 10**9, 102, 103, 50, 51, 101]
    assert refused(desk, [image(stamp, drawn()) for stamp in stamps]) == [7]
    assert [fields["header"]["stamp"]["sec"] for _, fields in desk.sent] == stamps[:7]


def test_stamps_are_kept_for_a_while(desk, monkeypatch):
    monkeypatch.setattr(exposures, "MOST_STAMPS", 3)
    assert refused(desk, [image(stamp, drawn()) for stamp in (1, 2, 3, 1, 4, 1)]) == [3]


def test_an_odd_first_image_does_not_define_the_size(desk):
    """Three alike settle it; later no number of others does."""
    sizes = [70, 80, 80, 70, 80, 80, 80, 80, 70, 70, 70, 70, 80]
    images = [image(number, drawn()[:rows]) for number, rows in enumerate(sizes)]
    assert refused(desk, images) == [1, 2, 4, 5, 8, 9, 10, 11]


def test_another_camera_on_the_topic_is_named_and_its_images_refused(desk):
    desk.session.take(image(1, drawn()))
    for stamp in (2, 4, 6):
        desk.session.take(image(stamp, drawn()))
        with pytest.raises(
            InputError, match="of the camera 'hand', earlier ones are of 'eye'"
        ):
            desk.session.take(image(stamp + 1, drawn(), "hand"))
    assert len(desk.sent) == 4


def test_of_a_settled_size_another_one_is_refused_before_it_is_decoded(desk):
    for stamp in range(exposures.SETTLED):
        desk.session.take(image(stamp, drawn()))
    other = image(9, drawn()[:60])
    other.data = Unreadable(60 * 90)
    with pytest.raises(
        InputError, match="90 x 60 pixels, but earlier images have 90 x 80"
    ):
        desk.session.take(other)


class Unreadable(bytes):
    """Data with a length that fails the test if its values are used."""

    def __new__(cls, length):
        return super().__new__(cls, length)

    def __buffer__(self, flags):
        pytest.fail("decoded")


def test_more_possible_marks_than_max_marks_refuse_the_image(desk):
    """Found before any of them is fitted."""
    grid = np.stack(np.meshgrid([-1e-4, 0.0, 1e-4], [-5e-5, 5e-5])).reshape(2, -1)
    values = Camera(width=190, height=150).image(grid, np.random.default_rng(1))
    for most, marks in ((6, 6), (5, None)):
        session = DetectingSession(
            DetectorSettings(pixel_size=2e-6, mark_size=5e-5, max_marks=most),
            SimpleNamespace(publish=lambda *given: desk.sent.append(given)),
        )
        if marks:
            session.take(image(1, values))
            assert len(desk.sent) == marks
            continue
        with pytest.raises(
            InputError, match="more than 5 possible marks; check mark_size"
        ):
            session.take(image(1, values))
        assert session.diagnosis().values["images_refused"] == 1


def test_images_that_come_again_under_other_stamps_are_an_error(desk):
    """A driver publishes each twice, or the camera did not expose: these repeats are none."""
    rng = np.random.default_rng(2)
    noisy = [CAMERA.image(np.zeros((2, 1)), rng) for _ in range(12)]
    for stamp, values in enumerate(noisy):
        desk.session.take(image(2 * stamp, values))
    found = desk.session.diagnosis()
    assert (found.level, "images_repeated" in found.values) == (Level.OK, False)
    for stamp, values in enumerate(noisy):
        desk.session.take(image(100 + 2 * stamp, values))
        desk.session.take(image(101 + 2 * stamp, values))
    assert desk.session.diagnosis().values["images_repeated"] == 12
    for stamp, values in enumerate(noisy):
        desk.session.take(image(200 + 2 * stamp, values))
        desk.session.take(image(201 + 2 * stamp, values))
        desk.session.take(image(300 + stamp, values))
    found = desk.session.diagnosis()
    assert found.level == Level.ERROR
    assert found.message.startswith("36 of 72 images are the one before them, pixel by")

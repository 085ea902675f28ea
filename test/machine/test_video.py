# SPDX-License-Identifier: Apache-2.0
"""A real VideoCapture: files of images, and a stream that goes on while nobody reads it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO

import numpy as np
import pytest
from PIL import Image as Pillow

from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.machine.video import VideoCamera, grey
from selfcal_ros.settings.estimator import read_plan
from test.machine.test_measuring import away_from
from test.support.cells import FEW, QUIET, Agreeing, write_cell
from test.support.faults import Spoilt

pytest.importorskip("cv2")
FRAMES_A_SECOND = 50


class Webcam:
    """Exposes what `picture` returns 50 times a second, whether or not anybody reads."""

    def __init__(self, picture) -> None:
        self.picture, self.unplugged = picture, threading.Event()

    def frames(self) -> Iterator[bytes]:
        while not self.unplugged.wait(1 / FRAMES_A_SECOND):
            file = BytesIO()
            Pillow.fromarray(self.picture()).save(
                file, "JPEG", quality=95, subsampling=0
            )
            yield file.getvalue()


@contextmanager
def streamed(webcam):
    """Yield the address of a stream of a webcam."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header(
                "Content-Type", "multipart/x-mixed-replace; boundary=frame"
            )
            self.end_headers()
            with suppress(OSError):
                for frame in webcam.frames():
                    self.wfile.write(
                        b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d"
                        b"\r\n\r\n%s\r\n" % (len(frame), frame)
                    )

        def log_message(self, *_):
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/stream.mjpg"
    finally:
        webcam.unplugged.set()
        server.shutdown()
        server.server_close()
        thread.join(5)


def flat(value: int) -> np.ndarray:
    return np.full((96, 128), value, np.uint8)


def test_frames_that_waited_in_a_buffer_are_not_taken_for_new_ones():
    now = [40]
    webcam = Webcam(lambda: flat(now[0]))
    with streamed(webcam) as address:
        camera = VideoCamera(address)
        for value in (200, 60, 120, 240):
            assert not webcam.unplugged.wait(0.3)  # 15 frames wait meanwhile
            now[0] = value
            assert camera.image().pixels.mean() == pytest.approx(value, abs=3)
        camera.close()


def test_a_camera_that_is_unplugged_is_named():
    webcam = Webcam(lambda: flat(90))
    with streamed(webcam) as address:
        camera = VideoCamera(address)
        camera.image()
        webcam.unplugged.set()
        with pytest.raises(
            MachineError, match=r"camera http.*no image any more; check the cable"
        ):
            camera.image()
        camera.close()


def test_a_camera_that_is_not_there(tmp_path):
    with pytest.raises(MachineError, match="cannot be opened"):
        VideoCamera(str(tmp_path / "none.avi"))


class WithVideo(Spoilt):
    """The simulated stage; its plate is seen by a webcam."""

    def image(self):
        return self.camera.image()


def test_a_plan_is_measured_with_a_webcam_that_never_waits(tmp_path):
    cell, simulated = write_cell(tmp_path, camera=True, simulation=QUIET, plan=FEW)
    guard = threading.Lock()

    def picture():
        with guard:
            return simulated.image().pixels

    class Guarded(WithVideo):
        """Moves while no frame is exposed."""

        def move_to(self, position):
            with guard:
                super().move_to(position)

        def place(self, placing):
            with guard:
                super().place(placing)

    with streamed(Webcam(picture)) as address:
        machine = Guarded(simulated)
        machine.camera = VideoCamera(address)
        plan = read_plan(tmp_path / "plan.yaml")
        Run(plan, cell, machine, tmp_path / "bag", Agreeing()).measure()
        machine.camera.close()
    away, _ = away_from(simulated.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8


def test_a_sequence_of_files_is_read_one_by_one_to_its_end(tmp_path):
    for number in range(3):
        Pillow.fromarray(flat(50 + 50 * number)).save(
            tmp_path / f"frame_{number:03}.png"
        )
    camera = VideoCamera(str(tmp_path / "frame_%03d.png"))
    assert [camera.image().pixels.mean() for _ in range(3)] == [50, 100, 150]
    with pytest.raises(MachineError, match="the file has ended"):
        camera.image()
    camera.close()


def test_a_size_that_the_camera_does_not_have(tmp_path):
    Pillow.fromarray(flat(50)).save(tmp_path / "frame_000.png")
    with pytest.raises(MachineError, match="its width is 128 instead of 640 pixels"):
        VideoCamera(str(tmp_path / "frame_%03d.png"), width=640)


def test_colours_become_their_mean():
    frame = np.dstack([flat(10), flat(20), flat(60)])
    assert (grey(frame) == 30).all()

"""Ctrl-C during the set-up, on a camera whose set-up takes many seconds."""

import signal
import subprocess
import sys
import threading
import time

import pytest

import rowburst as rb

SET_UP = """
import signal

import numpy as np
import rowburst as rb

# Jobs in the background of a shell ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
camera = rb.Camera(rows=512, columns=512, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
psf = rb.Psf(np.random.default_rng(1).random((1023, 1023), np.float32))
frame = np.random.default_rng(2).random((512, 512), np.float32)
{before}
print("ready", flush=True)
try:
    {call}
except KeyboardInterrupt:
    print("interrupted", flush=True)
else:
    print("not interrupted", flush=True)
"""

# A file of 3 GB that takes no room on the disk.
STACK = """
header = np.lib.format.open_memmap("stack.npy", "w+", np.uint16, (1500, 1000, 1000))
del header
"""

RESULT = """
small = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
made = rb.simulate(small, "moving")
result = rb.reconstruct(made.frame, small, made.psf, prior="tv", max_iterations=3)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    "call",
    ['rb.reconstruct(frame, camera, psf, prior="tv")', "rb.LiveView(camera, psf)", "rb.Reconstructor(camera, psf)"],
)
def test_ctrl_c_is_heard_during_the_set_up(call):
    interrupt(SET_UP.format(before="", call=call))


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    ("before", "call"),
    [
        (RESULT, 'result.save("result")'),
        (STACK, 'rb.read_frames("stack.npy")'),
    ],
)
def test_ctrl_c_is_heard_by_what_has_no_progress(before, call, tmp_path):
    interrupt(SET_UP.format(before=before, call=call), wait_s=0.3, folder=tmp_path)


MAP = """
reconstructor = rb.Reconstructor(small, made.psf, prior="tv+0.5*tdiff+support", threads=1)
stack = [made.frame] * 50
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    "call",
    [
        "list(reconstructor.map(stack, workers=2))",
        'rb.batch(np.stack(stack), "videos.zarr", small, made.psf, prior="tv+0.5*tdiff+support")',
    ],
)
def test_ctrl_c_ends_many_frames(call, tmp_path):
    interrupt(SET_UP.format(before=RESULT + MAP, call=call), folder=tmp_path)


def test_a_map_that_is_left_early_ends_its_frames():
    """The threads of a map do not go on once nobody takes its results."""
    small = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    made = rb.simulate(small, "moving")
    reconstructor = rb.Reconstructor(small, made.psf, prior="tv", threads=1)
    results = reconstructor.map([made.frame] * 20, workers=3)
    next(results)
    began = time.monotonic()
    results.close()
    assert time.monotonic() - began < 0.5
    until = began + 20
    while any(t.name.startswith("rowburst") for t in threading.enumerate()) and time.monotonic() < until:
        time.sleep(0.05)
    assert not [t for t in threading.enumerate() if t.name.startswith("rowburst")]


def interrupt(program, wait_s=1.5, folder=None):
    """Runs a program, and sends it Ctrl-C once it works."""
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder
    )
    assert process.stdout.readline() == "ready\n"
    time.sleep(wait_s)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "interrupted\n"
    assert time.monotonic() - began < 1.0
    # The process ends, although the work was in the middle.
    assert process.wait(timeout=20) == 0

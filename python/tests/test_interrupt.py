"""Ctrl-C during the set-up, on a camera whose set-up takes many seconds."""

import signal
import subprocess
import sys
import time

import pytest

SET_UP = """
import signal

import numpy as np
import rowburst as rb

# Jobs in the background of a shell ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
camera = rb.Camera(rows=512, columns=512, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
psf = rb.Psf(np.random.default_rng(1).random((1023, 1023), np.float32))
frame = np.random.default_rng(2).random((512, 512), np.float32)
print("ready", flush=True)
try:
    {call}
except KeyboardInterrupt:
    print("interrupted", flush=True)
else:
    print("not interrupted", flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    "call",
    ['rb.reconstruct(frame, camera, psf, prior="tv")', "rb.LiveView(camera, psf)", "rb.Reconstructor(camera, psf)"],
)
def test_ctrl_c_is_heard_during_the_set_up(call):
    process = subprocess.Popen(
        [sys.executable, "-c", SET_UP.format(call=call)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout.readline() == "ready\n"
    time.sleep(1.5)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "interrupted\n"
    assert time.monotonic() - began < 1.0
    # The process ends, although the set-up was in the middle of its work.
    assert process.wait(timeout=20) == 0

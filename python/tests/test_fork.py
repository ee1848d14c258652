"""Threads: a forked process raises at once, and their number may be set late where nothing has run."""

import os
import subprocess
import sys

import pytest

SETUP = """
import multiprocessing, os, sys
import numpy as np, rowburst as rb
camera = rb.Camera(rows=24, columns=30, shutter="top-down", row_time_us=10, exposure_us=10)
rng = np.random.default_rng(1)
frame, psf = rng.uniform(1, 2, (24, 30)), rng.exponential(size=(47, 59))
def work(_=None):
    return rb.reconstruct(frame, camera, psf, prior="tv", max_iterations=3).iterations
"""


def run(script, **environment):
    """What ``script`` prints; a process that hangs fails the test."""
    done = subprocess.run(
        [sys.executable, "-c", SETUP + script], capture_output=True, text=True, timeout=100, env=os.environ | environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")


@needs_fork
@pytest.mark.parametrize(
    "call",
    [
        "work()",
        "rb.simulate(camera, 'digits', psf)",
        "rb.operator(camera, psf)",
        "operator @ np.ones(operator.shape[1], np.float32)",
        "operator.H @ np.ones(operator.shape[0])",
        "operator.data_term(frame)",
        "result.numbers",
        "result.report()",
        "rb.LiveView(camera, psf)",
        "rb.set_threads(1)",
    ],
)
def test_a_fork_after_computing_raises_at_once(call):
    said = run(f"""
operator, result = rb.operator(camera, psf), rb.reconstruct(frame, camera, psf, prior="tv", max_iterations=3)
operator @ np.ones(operator.shape[1])
pid = os.fork()
if pid == 0:
    try:
        {call}
        print("went through", flush=True)
    except rb.WorkError as error:
        print(error, flush=True)
    os._exit(0)
os.waitpid(pid, 0)
""")
    assert "forked" in said and "spawn" in said and "forkserver" in said


@needs_fork
def test_a_pool_of_forked_processes_raises():
    said = run("""
if __name__ == "__main__":
    work()
    with multiprocessing.get_context("fork").Pool(2) as pool:
        try:
            pool.map(work, range(3))
        except rb.WorkError as error:
            print(error)
""")
    assert "forkserver" in said


@needs_fork
def test_a_fork_before_computing_works():
    said = run("""
rb.threads()
rb.set_threads(2)
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(pool.map(work, range(3)))
print(work())
""")
    assert said.split("\n")[:2] == ["[3, 3, 3]", "3"]


def test_threads_may_be_set_after_they_were_counted():
    said = run("""
print(rb.threads())
rb.set_threads(3)
rb.set_threads(2)
print(rb.threads())
work()
print(rb.threads())
rb.set_threads(2)
try:
    rb.set_threads(5)
except rb.WorkError as error:
    print(error)
""", RAYON_NUM_THREADS="4")
    assert said.splitlines()[:3] == ["4", "2", "2"]
    assert "5 are requested and 2 run already" in said and "Restart" in said


@needs_fork
def test_a_pool_that_is_given_a_set_up_object_raises():
    """It is unpickled in the worker; an error there would end the worker, and the pool would wait for ever."""
    said = run("""
class Call:
    def __init__(self, name, given):
        self.name, self.given = name, given
    def __call__(self, x):
        return getattr(self.given, self.name)(x)
if __name__ == "__main__":
    reconstructor = rb.Reconstructor(camera, psf, prior="tv", max_iterations=3)
    operator = rb.operator(camera, psf)
    term = operator.data_term(frame)
    video = np.ones(operator.shape[1])
    for call, x in ((reconstructor, frame), (Call("matvec", operator), video), (Call("grad", term), video)):
        with multiprocessing.get_context("fork").Pool(2) as pool:
            try:
                pool.map(call, [x, x])
            except rb.WorkError as error:
                print(error)
""")
    assert said.count("forkserver") == 3

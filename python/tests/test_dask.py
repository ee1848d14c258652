"""A scheduler and three worker processes on loopback, one of which is killed in mid-run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb
from rowburst._rowburst import _Batch

distributed = pytest.importorskip("distributed")
FRAMES = 24


@pytest.fixture
def recording(tmp_path, capture, camera, psf):
    rng = np.random.default_rng(8)
    frames = [capture.frame * rng.uniform(0.5, 2) + rng.normal(size=capture.frame.shape).astype(np.float32) * 1e-3
              for _ in range(FRAMES)]
    np.save(tmp_path / "frames.npy", np.stack(frames).astype(np.float32))
    np.save(tmp_path / "psf.npy", psf.array)
    (tmp_path / "experiment.toml").write_text(camera.to_toml() + '\n[calibration]\npsf = "psf.npy"\n')
    return tmp_path


def videos(folder, out, **options):
    batch = _Batch(folder / "experiment.toml", folder / "frames.npy", folder / out, **options)
    return batch, [batch.video(i) for i in range(batch.count)]


def started(*words):
    """A process of Dask, in a session of its own."""
    environment = os.environ | {"RAYON_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env=environment, start_new_session=True)


def scheduler_of(file):
    """A scheduler without workers; its process."""
    scheduler = started("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
                        "--scheduler-file", str(file))
    deadline = time.monotonic() + 60
    while not file.exists():
        assert time.monotonic() < deadline, "the scheduler did not start"
        time.sleep(0.1)
    return scheduler


@pytest.fixture
def cluster(tmp_path):
    file = tmp_path / "scheduler.json"
    scheduler = scheduler_of(file)
    workers = [started("distributed.cli.dask_worker", "--host", "127.0.0.1", "--no-dashboard", "--no-nanny",
                       "--nthreads", "1", "--scheduler-file", str(file), "--local-directory", str(tmp_path / f"w{i}"))
               for i in range(3)]
    try:
        with distributed.Client(scheduler_file=str(file), timeout=60) as client:
            client.wait_for_workers(3, timeout=60)
            yield client, {w.pid: w for w in workers}
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


def test_a_killed_worker_changes_nothing(recording, cluster):
    client, workers = cluster
    options = {"prior": "tv+0.5*tdiff+support", "max_iterations": 60}
    killed = []

    def progress(done, of):
        if not killed and done >= 3:
            # One that is at work now.
            pid = next(iter(client.run(os.getpid).values()))
            workers[pid].send_signal(signal.SIGKILL)
            workers[pid].wait()
            killed.append(done)

    summary = rb_dask().reconstruct(
        recording / "frames.npy", recording / "cluster.zarr", recording / "experiment.toml", client,
        frames_per_task=1, progress=progress, **options)
    assert killed and killed[0] < FRAMES
    assert len(client.scheduler_info()["workers"]) == 2
    assert (summary["done"], summary["failed"], summary["left"]) == (FRAMES, 0, 0)
    batch, cluster_videos = videos(recording, "cluster.zarr", **options)
    assert batch.left(0, FRAMES) == []
    single, _ = videos(recording, "single.zarr", **options)
    single.run(list(range(FRAMES)), 1)
    for i, video in enumerate(cluster_videos):
        np.testing.assert_array_equal(video, single.video(i))
        assert np.isfinite(video).all()
    table = Path(summary["table"]).read_text().splitlines()
    assert len(table) == FRAMES + 1
    # Once more: nothing is left to do.
    again = rb_dask().reconstruct(
        recording / "frames.npy", recording / "cluster.zarr", recording / "experiment.toml", client, **options)
    assert again["frames_this_run"] == 0


def test_the_command_line_hands_the_work_to_the_scheduler(recording, cluster):
    program = os.environ.get("ROWBURST")
    if not program:
        pytest.skip("ROWBURST does not name the program")
    client, _ = cluster
    words = [program, "batch", "experiment.toml", "--frames", "frames.npy", "--prior", "tv", "--max-iterations", "40", "--json"]
    environment = os.environ | {"ROWBURST_PYTHON": sys.executable}
    for out, more in (("cluster.zarr", ["--scheduler", client.scheduler.address]), ("single.zarr", [])):
        done = subprocess.run([*words, "-o", out, *more], cwd=recording, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        summary = json.loads(done.stdout)
        assert (summary["done"], summary["left"]) == (FRAMES, 0)
        # All frames were made elsewhere, or here.
        assert summary["frames_this_run"] == (0 if more else FRAMES)
    options = {"prior": "tv", "max_iterations": 40}
    for one, other in zip(videos(recording, "cluster.zarr", **options)[1], videos(recording, "single.zarr", **options)[1]):
        np.testing.assert_array_equal(one, other)


def rb_dask():
    import rowburst.dask

    return rowburst.dask


def test_mistakes_are_found_before_a_worker_sees_them(recording):
    with pytest.raises(rb.InputError, match="nowhere.npy"):
        rb_dask().reconstruct(recording / "nowhere.npy", recording / "o.zarr", recording / "experiment.toml", None)
    with pytest.raises(rb.InputError, match="prior"):
        rb_dask().reconstruct(
            recording / "frames.npy", recording / "o.zarr", recording / "experiment.toml", None, prior="tvv")
    assert not (recording / "o.zarr").exists()


def test_without_a_scheduler_it_says_so(recording):
    done = subprocess.run(
        [sys.executable, "-m", "rowburst.dask", recording / "experiment.toml", "--frames", recording / "frames.npy",
         "-o", recording / "o.zarr", "--scheduler", "tcp://127.0.0.1:9"],
        env=os.environ | {"ROWBURST_SCHEDULER_TIMEOUT_S": "1"}, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "no scheduler answers" in done.stderr, done.stderr


def test_without_workers_it_says_so_after_a_time(recording, tmp_path):
    scheduler = scheduler_of(tmp_path / "alone.json")
    try:
        with distributed.Client(scheduler_file=str(tmp_path / "alone.json"), timeout=60) as client:
            with pytest.raises(rb.WorkError, match="no worker has joined .* within 1 s.*dask worker tcp://"):
                rb_dask().reconstruct(
                    recording / "frames.npy", recording / "o.zarr", recording / "experiment.toml", client,
                    workers_timeout_s=1, prior="tv")
    finally:
        scheduler.kill()
        scheduler.wait()


def test_an_archive_that_is_begun_anew_is_another_one(recording):
    options = {"prior": "tv", "max_iterations": 5}
    job = json.dumps({
        "experiment": str(recording / "experiment.toml"), "frames": str(recording / "frames.npy"),
        "out": str(recording / "o.zarr"), **options})
    for _ in range(2):
        # What the client does; then a worker that has seen the archive before.
        _Batch(recording / "experiment.toml", recording / "frames.npy", recording / "o.zarr", **options)
        assert rb_dask()._part(job, rb.__version__, [0, 1], 1) == (2, 0)
        batch = _Batch(recording / "experiment.toml", recording / "frames.npy", recording / "o.zarr", **options)
        assert batch.left(0, 3, False) == [2]
        assert np.isfinite(batch.video(1)).all()
        shutil.rmtree(recording / "o.zarr")

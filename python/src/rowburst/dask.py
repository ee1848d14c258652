"""Recordings on a Dask cluster: ``rowburst batch`` on the workers of a scheduler.

    python3 -m rowburst.dask experiment.toml --frames frames.zarr -o videos.zarr --scheduler tcp://host:8786

A task is a range of frames, done by the code of ``rowburst batch`` into the same archive, which all
workers reach on a shared disk. A frame counts as done once its line is written, after its video; so a
task whose worker was killed is just run again, and the archive is that of one machine, bit for bit.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._checks import check_number, checked_whole
from ._extras import need
from ._rowburst import InputError, WorkError, _Batch, __version__

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["reconstruct"]

_FILES = ("psf", "dark", "flat", "bad_pixels")


def _opened(job: str) -> _Batch:
    """The batch of a worker process: its operator and Gram blocks are made once, for all its tasks."""
    begun = os.stat(Path(json.loads(job)["out"]) / "rowburst" / "job.json")
    # An archive that was deleted and restarted under the same name is another one.
    return _opened_as(job, begun.st_ino, begun.st_mtime_ns)


@lru_cache(maxsize=2)
def _opened_as(job: str, inode: int, mtime_ns: int) -> _Batch:
    options = json.loads(job)
    return _Batch(options.pop("experiment"), options.pop("frames"), options.pop("out"), **options)


def _choose(job: str, version: str) -> tuple[str, str]:
    """Chooses the prior of all frames, on a worker."""
    _same_version(version)
    return _opened(job).prior()


def _part(job: str, version: str, frames: list[int], threads: int) -> tuple[int, int]:
    """Reconstructs those of ``frames`` that are not done: how many were run, and how many of these failed."""
    _same_version(version)
    batch = _opened(job)
    left = set(batch.left(min(frames), max(frames) + 1, True))
    lines = batch.run([frame for frame in frames if frame in left], threads)
    return len(lines), sum(not line[2] for line in lines)


def _same_version(version: str) -> None:
    if version != __version__:
        raise WorkError(
            f"worker: rowburst {__version__} here, {version} at the client; an archive is of one version. "
            "Install the same version on all machines."
        )


def _wait_for_workers(client: Client, seconds: float) -> None:
    try:
        client.wait_for_workers(1, timeout=seconds)
    except TimeoutError as error:
        address = client.scheduler_info()["address"]
        raise WorkError(
            f"{address}: no worker has joined the scheduler within {seconds:g} s; the frames are made by its "
            f"workers. Start some: dask worker {address} --nthreads 1 --nworkers auto"
        ) from error


def reconstruct(
    frames: str | PathLike[str],
    out: str | PathLike[str],
    experiment: str | PathLike[str],
    client: Client,
    *,
    frames_per_task: int | None = None,
    threads_per_task: int = 1,
    retry_failed: bool = False,
    workers_timeout_s: float = 600,
    progress: Callable[[int, int], object] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Reconstructs every frame of a recording into one OME-Zarr archive, on the workers of ``client``.

    Called again, it goes on where it was. Give workers one Dask thread for each core: a frame on one thread beats many
    threads on one frame.

    Parameters
    ----------
    frames : path
        What ``rowburst batch --frames`` takes: a Zarr array ``[frame, y, x]``, a folder, a stack.
    out : path
        The archive. All paths must be the same for client and workers.
    experiment : path
        The experiment file.
    client : distributed.Client
        The client of a scheduler.
    frames_per_task : int, optional
        Frames of a task; by default several tasks for each thread.
    threads_per_task : int
        Threads that a task uses.
    retry_failed : bool
        Whether frames that failed before are tried again.
    workers_timeout_s : float
        How long the first worker is waited for, in seconds.
    progress : callable, optional
        Called as ``progress(done, of)`` after every task.
    **options
        Those of ``rowburst batch``: psf, dark, flat, bad_pixels (files), prior, tau, noise_sigma, max_iterations,
        frame_period_us, self_calibrate, keep_all_pixels.

    Returns
    -------
    dict
        A summary; the table of all frames is ``OUT.zarr/rowburst/frames.csv``.

    Raises
    ------
    InputError
        An argument breaks a rule, the archive was begun with other settings, or dask.distributed is not installed.
    WorkError
        No worker joined the scheduler in time, or the work failed.

    Examples
    --------
    ::

        with distributed.Client("tcp://host:8786") as client:
            summary = rowburst.dask.reconstruct("frames.zarr", "videos.zarr", "experiment.toml", client)
    """
    as_completed = need("distributed", "rowburst.dask.reconstruct").as_completed
    threads_per_task = checked_whole("threads_per_task", threads_per_task, 1)
    frames_per_task = None if frames_per_task is None else checked_whole("frames_per_task", frames_per_task, 1)
    check_number("workers_timeout_s", workers_timeout_s)
    given = {name: value for name, value in options.items() if value is not None}
    for name in _FILES:
        if name in given:
            given[name] = str(Path(given[name]).absolute())
    if "tau" in given:
        given["tau"] = str(given["tau"])
    paths = {"experiment": experiment, "frames": frames, "out": out}
    absolute_paths = {name: str(Path(path).absolute()) for name, path in paths.items()}
    # Begins the archive, and finds every mistake before a worker sees it.
    batch = _Batch(absolute_paths["experiment"], absolute_paths["frames"], absolute_paths["out"], **given)
    job = json.dumps(absolute_paths | given, sort_keys=True)
    left = batch.left(0, batch.count, retry_failed)
    _wait_for_workers(client, workers_timeout_s)
    prior, reason = client.submit(_choose, job, __version__, pure=False).result()
    if frames_per_task is None:
        # Several tasks for each thread, so that none waits long for the last one.
        workers = sum(client.nthreads().values()) or 1
        frames_per_task = max(1, min(16, len(left) // (4 * workers)))
    parts = [left[i : i + frames_per_task] for i in range(0, len(left), frames_per_task)]
    futures = [client.submit(_part, job, __version__, part, threads_per_task, pure=False, retries=3) for part in parts]
    made = done = 0
    sizes = {future.key: len(part) for future, part in zip(futures, parts, strict=True)}
    try:
        for future, (count, _) in as_completed(futures, with_results=True):
            made += count
            done += sizes[future.key]
            if progress is not None:
                progress(done, len(left))
    except BaseException:
        client.cancel(futures)
        raise
    table = batch.write_table()
    rows = batch.rows()
    failed = [row for row in rows if not row[2]]
    return {
        "version": __version__,
        "archive": absolute_paths["out"],
        "table": str(table),
        "frames": batch.count,
        "done": len(rows) - len(failed),
        "failed": len(failed),
        "left": batch.count - len(rows),
        "frames_this_run": made,
        "prior": prior,
        "prior_reason": reason,
        "warnings": [f"no video of {row[1]}: {row[6]}" for row in failed[:10]],
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python3 -m rowburst.dask",
        description="rowburst batch on the workers of a Dask scheduler.",
        epilog="Example: python3 -m rowburst.dask experiment.toml --frames frames.zarr -o videos.zarr "
        "--scheduler tcp://127.0.0.1:8786",
    )
    parser.add_argument("experiment")
    parser.add_argument("--frames", required=True, help="the recording, as for rowburst batch")
    parser.add_argument("-o", "--output", required=True, help="the archive, on a disk that all workers reach")
    parser.add_argument("--scheduler", required=True, help="address of the scheduler, tcp://HOST:PORT")
    for name in _FILES:
        parser.add_argument(f"--{name.replace('_', '-')}", help="instead of the experiment's")
    parser.add_argument("--prior")
    parser.add_argument("--tau")
    parser.add_argument("--noise-sigma", type=float)
    parser.add_argument("--max-iterations", type=int)
    parser.add_argument("--frame-period-us", type=float)
    parser.add_argument("--self-calibrate", help="off, auto or on: correct PSF and camera by four frames together")
    parser.add_argument("--keep-all-pixels", action="store_true", help="do not look for foreign pixels")
    parser.add_argument("--retry-failed", action="store_true")
    parser.add_argument("--frames-per-task", type=int)
    parser.add_argument("--workers-timeout-s", type=float, default=600, help="how long to wait for the first worker [600]")
    parser.add_argument("--json", action="store_true", help="the summary as JSON")
    return parser


def _main() -> int:
    args = vars(_parser().parse_args())
    try:
        from distributed import Client
    except ImportError:
        print("error: dask.distributed is missing. Install it: pip install 'rowburst[dask]'", file=sys.stderr)
        return 1
    scheduler, as_json = args.pop("scheduler"), args.pop("json")

    def print_progress(done: int, of: int) -> None:
        if sys.stderr.isatty():
            print(f"\r{done} of {of} frames", end="" if done < of else "\n", file=sys.stderr, flush=True)

    try:
        with Client(scheduler, timeout=int(os.environ.get("ROWBURST_SCHEDULER_TIMEOUT_S", "15"))) as client:
            if not client.nthreads():
                print(f"{scheduler} has no worker yet: waiting up to {args['workers_timeout_s']:g} s", file=sys.stderr)
            summary = reconstruct(
                args.pop("frames"), args.pop("output"), args.pop("experiment"), client, progress=print_progress, **args
            )
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (OSError, TimeoutError) as error:
        print(f"error: {scheduler}: no scheduler answers ({error}). Start one: dask scheduler", file=sys.stderr)
        return 1
    except Exception as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if as_json:
        print(json.dumps(summary, indent=2))
    else:
        print(f"{summary['archive']}: {summary['done']} of {summary['frames']} frames have their video")
        print(f"prior: {summary['prior']} ({summary['prior_reason']})\ntable: {summary['table']}")
        for warning in summary["warnings"]:
            print(f"warning: {warning}", file=sys.stderr)
    return 0 if summary["done"] or not summary["frames"] else 1


if __name__ == "__main__":
    # Workers find the tasks by their module's name, which is not __main__ there.
    from rowburst.dask import _main as main

    sys.exit(main())

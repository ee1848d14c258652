"""What does not fit into memory is refused before the system ends the process."""

import subprocess
import sys

import numpy as np
import pytest

import rowburst as rb


def sparse_stack(path, bytes_wanted):
    """A .npy stack of 16 bits that takes no room on the disk."""
    shape = (int(bytes_wanted // (2 * 4000 * 4000)) + 1, 4000, 4000)
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<u2", "fortran_order": False, "shape": shape})
        file.truncate(file.tell() + 2 * int(np.prod(shape, dtype=np.int64)))
    return shape


def memory_bytes():
    """Memory and swap of this machine."""
    with open("/proc/meminfo") as file:
        fields = dict(line.split(":") for line in file)
    return 1024 * sum(int(fields[name].split()[0]) for name in ("MemTotal", "SwapTotal"))


@pytest.mark.skipif(sys.platform != "linux", reason="the size of the memory is asked of Linux")
def test_a_recording_larger_than_memory_is_refused(tmp_path):
    shape = sparse_stack(tmp_path / "stack.npy", 1.2 * memory_bytes())
    program = "import sys, rowburst as rb\ntry: rb.read_frames(sys.argv[1])\nexcept rb.WorkError as e: print(e.kind, e)"
    done = subprocess.run([sys.executable, "-c", program, tmp_path / "stack.npy"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("memory") and f"no memory for {shape[0]} frames" in done.stdout
    # One frame at a time is no matter.
    assert rb._rowburst._Frames(tmp_path / "stack.npy")[0].shape == (4000, 4000)


def test_frames_take_the_memory_of_their_own_type(tmp_path):
    """Of 16 bits, not of the 32 that the frames are read as."""
    np.save(tmp_path / "stack.npy", np.zeros((400, 500, 500), np.uint16))
    program = (
        "import resource, sys, rowburst as rb\n"
        "peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "before = peak()\n"
        "frames = rb.read_frames(sys.argv[1])\n"
        "assert frames.dtype == 'uint16'\n"
        "print((peak() - before) / frames.nbytes)\n"
    )
    if sys.platform != "linux":
        pytest.skip("the unit of ru_maxrss is that of Linux")
    done = subprocess.run([sys.executable, "-c", program, tmp_path / "stack.npy"], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 1.5


@pytest.mark.skipif(sys.platform != "linux", reason="the size of the memory is asked of Linux")
def test_a_chunk_larger_than_memory_is_refused(tmp_path):
    camera = rb.Camera(rows=2048, columns=2048, shutter="top-down", row_time_us=10, exposure_us=10)
    frame = np.random.default_rng(1).random((2048, 2048), np.float32)
    with pytest.raises(rb.WorkError, match="no memory for a chunk of 2048 bins.*bins_per_chunk") as error:
        rb.reconstruct_chunked(frame, tmp_path / "out", camera, np.eye(5), bins_per_chunk=2048, prior="tv")
    assert error.value.kind == "memory"
    assert not (tmp_path / "out" / "result.json").exists()

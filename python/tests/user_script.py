"""What a user does with the package alone, without the command line: calibrate, read, reconstruct, plot, napari, Dask.

``tests/test_user_script.py`` runs it; for another Python: ``pythonX.Y user_script.py`` with the wheel installed. Parts
whose package is missing are left out, and named on the last line.
"""

import os
import sys
from pathlib import Path

import numpy as np

import rowburst as rb


def calibrated(rng, camera):
    """A sensor calibrated by dark and flat frames, and the camera that has its numbers."""
    levels = np.repeat(np.linspace(500, 20000, 10), 4)
    darks = rng.normal(100, 2, (16, 24, 30)).round().clip(0).astype(np.uint16)
    flats = [(0.5 * rng.poisson(2 * level, (24, 30)) + rng.normal(100, 2, (24, 30))).round().clip(0) for level in levels]
    sensor = rb.calibrate.sensor(darks, np.array(flats, np.uint16))
    camera = camera.replace(**sensor.camera_fields)
    assert abs(camera.gain_electrons_per_count - 2) < 0.2 and abs(camera.bias_counts - 100) < 1
    return sensor, camera


def main():
    left_out = []
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    rng = np.random.default_rng(3)
    camera = rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, bit_depth=16)
    sensor, camera = calibrated(rng, camera)
    psf = rb.Psf(rng.exponential(size=(47, 59)))
    made = rb.simulate(camera, "moving", psf, peak_electrons=40000, digit_px=8)
    np.save("psf.npy", psf.array)
    np.save("recording.npy", np.stack([made.frame, made.frame]))
    files = '[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "tv"\n'
    Path("experiment.toml").write_text(camera.to_toml() + files)

    experiment = rb.Experiment("experiment.toml", frame="recording.npy")
    frames = rb.read_frames("recording.npy")
    assert frames.dtype == np.uint16
    reconstructor = experiment.reconstructor(threads=1)
    result = reconstructor(frames[0])
    for other in (rb.reconstruct(frames[0], experiment), *reconstructor.map(frames)):
        assert (other.video == result.video).all()
    corrected = frames[0] - camera.bias_counts
    rb.reconstruct(corrected, experiment, corrected=True, max_iterations=3)
    assert rb.batch(frames, "videos.zarr", experiment)["done"] == 2
    assert reconstructor.live().next(frames[0]).video.shape == camera.video_shape
    operator = rb.operator(camera, psf)
    assert operator(result.video).shape == camera.frame_shape
    assert (rb.load(result.save("result")).video == result.video).all()

    try:
        import matplotlib
    except ImportError:
        left_out.append("matplotlib")
    else:
        matplotlib.use("Agg")
        result.plot()[0, 0].figure.savefig("result.png")
        assert Path("result.png").stat().st_size > 10_000
    try:
        from napari.components import ViewerModel
        from npe2 import PluginManager
    except ImportError:
        left_out.append("napari")
    else:
        PluginManager.instance().discover()
        layers = ViewerModel().open("result", plugin="rowburst")
        assert (layers[0].data == result.video).all()
    try:
        from distributed import Client
    except ImportError:
        left_out.append("dask")
    else:
        import dask.array

        stack = dask.array.from_array(frames, chunks=(1, -1, -1))
        assert [(r.video == result.video).all() for r in reconstructor.map(stack)] == [True, True]
        with Client(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None) as client:
            found = client.submit(reconstructor, frames[0]).result(timeout=120)
        assert (found.video == result.video).all()
    print(f"Python {sys.version.split()[0]}, rowburst {rb.__version__}: done; left out: {', '.join(left_out) or 'nothing'}")


if __name__ == "__main__":
    main()

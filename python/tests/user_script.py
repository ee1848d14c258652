"""What a user does with the package alone, without the command line: calibrate, read, reconstruct, plot, napari, Dask.

``tests/test_user_script.py`` runs it; for another Python: ``pythonX.Y user_script.py`` with the wheel installed. Parts
whose package is missing are left out, and named on the last line.
"""

import json
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


def optics(rng):
    """A PSF from captures of a point source, and the timing from the stripes of a blinking light."""
    planned = rb.Camera(rows=96, columns=96, shutter="top-down", row_time_us=10, exposure_us=10)
    point = rb.speckle_psf(planned, diffuser_deg=0.4).array
    shots = [(100 + rng.poisson(20000 * point / point.max())).astype(np.uint16) for _ in range(3)]
    found = rb.calibrate.psf(np.stack(shots), dark=np.full(point.shape, 100))
    assert found.numbers["contrast"] > 0.5 and found.psf.shape == point.shape
    row = np.arange(512)[:, None] * 9.6e-6
    stripes = (1000 + 600 * np.sin(2 * np.pi * 2000 * row) + rng.normal(0, 8, (512, 40))).round().astype(np.uint16)
    timing = rb.calibrate.timing(stripes, frequency_hz=2000)
    assert abs(timing.camera_fields["row_time_us"] - 9.6) < 0.02


def recording(frames, left_out):
    """The recording as a camera's software leaves it, with its settings; .npy without tifffile."""
    try:
        import tifffile
    except ImportError:
        left_out.append("tifffile")
        np.save("recording.npy", frames)
        return "recording.npy"
    record = json.dumps({"Width": 30, "Height": 24, "Exposure-ms": 0.0096, "BitDepth": 16, "Camera": "Zyla"})
    tag = (51123, 2, None, record, True)
    tifffile.imwrite("recording.ome.tif", frames, metadata={"axes": "TYX"}, extratags=[tag])
    settings = rb.read_settings("recording.ome.tif")
    assert (settings["rows"], settings["columns"], settings["exposure_us"]) == (24, 30, 9.6)
    return "recording.ome.tif"


def main():
    left_out = []
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    rng = np.random.default_rng(3)
    camera = rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, bit_depth=16)
    sensor, camera = calibrated(rng, camera)
    psf = rb.Psf(rng.exponential(size=(47, 59)))
    made = rb.simulate(camera, "moving", psf, peak_electrons=40000, digit_px=8)
    np.save("psf.npy", psf.array)
    optics(rng)
    path = recording(np.stack([made.frame, made.frame]), left_out)
    files = '[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "tv"\n'
    Path("experiment.toml").write_text(camera.to_toml() + files)

    experiment = rb.Experiment("experiment.toml", frame=path)
    frames = rb.read_frames(path)
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

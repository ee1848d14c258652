"""What a new user writes from the documentation: calibrate, reconstruct, save, and answer an error by its kind."""

import numpy as np

import rowburst as rb


def test_calibrate_reconstruct_and_save(tmp_path):
    camera = rb.Camera(rows=48, columns=48, shutter="top-down", row_time_us=10, exposure_us=10, bias_counts=100)
    optics = rb.speckle_psf(camera, diffuser_deg=0.4)
    capture = (100 + 40000 * optics.array / optics.array.max()).round().astype(np.uint16)
    psf = rb.calibrate.psf(capture, dark=np.full(capture.shape, 100)).psf
    frame = rb.simulate(camera, "moving", optics, snr=256, digit_px=8).frame

    try:
        result = rb.reconstruct(frame[1:], camera, psf, prior="tv")
    except rb.InputError as error:
        if (error.parameter, error.kind) != ("frame", "shape"):
            raise
        result = rb.reconstruct(frame, camera, psf, prior="tv")

    result.save(tmp_path / "result")
    assert (rb.load(tmp_path / "result").video == result.video).all()

"""What results look like and cost to look at."""

import pickle

import numpy as np
import pytest

import rowburst as rb


def test_a_report_is_short_in_a_terminal_and_whole_in_a_notebook(result):
    report = result.report()
    assert len(repr(report)) < 100 and "kB" in repr(report)
    assert str(report).startswith("<!") and report[:100] == str(report)[:100]
    assert "iframe" in report._repr_html_() and len(report._repr_html_()) > len(report)


def test_numbers_are_computed_once(capture, camera, psf, monkeypatch):
    result = rb.reconstruct(capture.frame, camera, psf, truth=capture.truth, prior="tv", max_iterations=5)
    first = result.numbers
    calls = []

    class Counted:
        def _json(self):
            calls.append(1)
            return "{}"

    monkeypatch.setattr(result, "_native", Counted())
    assert result.numbers == first and not calls
    first["tau"] = None
    assert result.numbers["tau"] is not None


def test_constants_of_the_solver_can_be_set(capture, camera, psf):
    def video(**options):
        return rb.reconstruct(capture.frame, camera, psf, prior="tv", max_iterations=10, **options).video

    np.testing.assert_array_equal(video(), video(tuning={}))
    assert not np.array_equal(video(), video(tuning={"continuation_factor": 1.0}))


@pytest.fixture(scope="module")
def moving():
    """A capture of a moving square: camera, PSF and frame."""
    camera = rb.Camera(rows=64, columns=64, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    rng = np.random.default_rng(5)
    psf = rb.Psf(rng.exponential(size=(127, 127)).astype(np.float32))
    scene = np.zeros(camera.video_shape, np.float32)
    for t in range(len(scene)):
        scene[t, 10 + t : 14 + t, 8 + t : 12 + t] = 1
    return camera, psf, rb.simulate(camera, scene, psf, snr=256, seed=2).frame


@pytest.fixture(scope="module")
def hot(moving):
    """The same with 1 % hot pixels: camera, PSF, frame and the mask of the hot pixels."""
    camera, psf, frame = moving
    frame, rng = frame.copy(), np.random.default_rng(6)
    is_hot = np.zeros(frame.shape, bool)
    is_hot.flat[rng.choice(frame.size, frame.size // 100, replace=False)] = True
    frame[is_hot] += frame.max()
    return camera, psf, frame, is_hot


def test_hot_pixels_are_found(hot):
    camera, psf, frame, is_hot = hot
    result = rb.reconstruct(frame, camera, psf, prior="tv+0.5*tdiff+support")
    excluded = result.excluded
    assert excluded.shape == camera.frame_shape and excluded.dtype == np.uint8
    found = excluded == 1
    assert (found & is_hot).sum() >= 0.9 * is_hot.sum()
    assert (found & ~is_hot).sum() <= 0.005 * is_hot.size
    assert np.isclose(result.excluded_fraction, found.mean())
    np.testing.assert_array_equal(result.residual[found], 0)
    numbers = result.numbers
    assert numbers["excluded_fraction"] == result.excluded_fraction
    assert numbers["effective_sigma"] == result.effective_sigma
    assert any(f"{found.sum()} foreign pixels" in warning for warning in numbers["warnings"])
    assert "Yellow: " in result.report()


def test_all_pixels_are_kept_on_request(hot):
    camera, psf, frame, _ = hot
    result = rb.reconstruct(frame, camera, psf, prior="tv+0.5*tdiff+support", keep_all_pixels=True)
    assert result.excluded_fraction == 0 and not result.excluded.any()
    assert not any("foreign" in warning for warning in result.numbers["warnings"])


def test_a_video_is_zero_where_the_frame_does_not_observe_it(camera, psf, capture, result):
    assert result.coverage.shape == camera.video_shape and result.coverage.dtype == np.uint8
    assert result.coverage_fraction == result.numbers["coverage_fraction"] == result.coverage.mean()
    # This PSF reaches 8 pixels, so the corners of the wide field are out of sight.
    wide = rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, field=(64, 70))
    small = rb.Psf(psf.array[15:32, 21:38])
    seen = rb.reconstruct(capture.frame, wide, small, prior="tv", max_iterations=10)
    assert 0 < seen.coverage_fraction < 1 and seen.coverage[:, 0, 0].max() == 0
    assert not seen.video[seen.coverage == 0].any()
    assert any("not observed" in warning for warning in seen.numbers["warnings"])
    corner, *_ = seen.traces([(1, 1)])
    assert np.isnan(corner.standard_error).all() and not corner.debiased.any()


def test_the_video_of_a_look_may_not_be_written_to(camera, psf, capture):
    look = rb.LiveView(camera, psf, prior="tv").next(capture.frame, time_budget_s=0.5)
    assert not look.video.flags.writeable
    np.testing.assert_equal(look.video.shape, camera.video_shape)


@pytest.fixture(scope="module")
def wrong_psf(hot):
    """The capture of `hot` without hot pixels, its PSF, and the same PSF 0.4 % too large."""
    ndimage = pytest.importorskip("scipy.ndimage")
    camera = hot[0]
    rng = np.random.default_rng(6)
    psf = np.maximum(ndimage.gaussian_filter(rng.exponential(size=(127, 127)), 1.2), 0)
    scene = np.zeros(camera.video_shape, np.float32)
    for t in range(len(scene)):
        scene[t, 10 + t : 14 + t, 8 + t : 12 + t] = 1
    frame = rb.simulate(camera, scene, psf, snr=256, seed=2).frame
    large = ndimage.affine_transform(psf, np.eye(2) / 1.004, 63 - 63 / 1.004, order=3)
    return camera, frame, scene, psf, np.maximum(large, 0)


def test_a_frame_corrects_its_psf(wrong_psf):
    camera, frame, scene, psf, large = wrong_psf
    options = {"prior": "tv+0.5*tdiff+support", "truth": scene}
    before = rb.reconstruct(frame, camera, large, self_calibrate="off", **options)
    after = rb.reconstruct(frame, camera, large, **options)
    assert before.self_calibration is None and before.corrected_psf is None
    assert abs(after.self_calibration["scale"]["value"] + 0.00398) < 2e-4
    assert after.numbers["psnr_db"] > before.numbers["psnr_db"] + 2
    # The corrected PSF serves the next frames as it is.
    again = rb.reconstruct(frame, camera, after.corrected_psf, **options)
    assert again.self_calibration is None
    assert again.numbers["psnr_db"] > after.numbers["psnr_db"] - 0.5
    same = pickle.loads(pickle.dumps(after))
    assert same.numbers == after.numbers and same.corrected_psf == after.corrected_psf


def test_a_reflection_is_taken_away(wrong_psf, tmp_path):
    camera, clean, _, psf, _ = wrong_psf
    y, x = np.ogrid[:64, :64]
    spot = 0.5 * clean.max() * np.exp(-((y - 24.0) ** 2 + (x - 36.0) ** 2) / 72)
    result = rb.reconstruct((clean + spot).astype(np.float32), camera, psf, prior="tv+0.5*tdiff+support")
    found = result.stray_light
    assert found.shape == camera.frame_shape and found.dtype == np.float32
    assert np.sqrt(np.mean((found - spot) ** 2)) < 0.05 * spot.max()
    assert np.isclose(result.stray_light_fraction, spot.sum() / (clean + spot).sum(), rtol=0.1)
    assert result.numbers["stray_light_fraction"] == result.stray_light_fraction
    assert any("smooth stray light" in warning for warning in result.numbers["warnings"])
    assert "Smooth stray light" in result.report()
    result.save(tmp_path)
    np.testing.assert_array_equal(rb.load(tmp_path).stray_light, found)
    copy = pickle.loads(pickle.dumps(result))
    np.testing.assert_array_equal(copy.stray_light, found)
    kept = rb.reconstruct(clean, camera, psf, prior="tv+0.5*tdiff+support", self_calibrate="off")
    assert kept.stray_light is None and kept.stray_light_fraction == 0


def test_a_frame_corrects_its_timing(wrong_psf):
    """Pickled results know it, too: their traces are those of the corrected camera."""
    camera, _, scene, psf, _ = wrong_psf
    next_bins = np.concatenate([scene[1:], scene[-1:]])
    light, next_light = (rb.simulate(camera, video, psf, snr=float("inf")).frame for video in (scene, next_bins))
    half = len(light) // 2
    light[half:] = 0.8 * light[half:] + 0.2 * next_light[half:]
    frame = light + np.random.default_rng(3).normal(0, np.sqrt(np.mean(light**2)) / 256, light.shape)
    result = rb.reconstruct(frame.astype(np.float32), camera, psf, prior="tv+0.5*tdiff+support")
    assert abs(result.self_calibration["half_delay_rows"]["value"] - 0.2) < 0.02
    same = pickle.loads(pickle.dumps(result))
    assert same.numbers == result.numbers
    for one, other in zip(same.traces([(15, 12)]), result.traces([(15, 12)])):
        np.testing.assert_array_equal(one.standard_error, other.standard_error)


def test_a_right_psf_is_used_as_given(wrong_psf):
    camera, frame, _, psf, _ = wrong_psf
    result = rb.reconstruct(frame, camera, psf, prior="tv+0.5*tdiff+support", self_calibrate="on")
    assert result.self_calibration is None


def test_self_calibrate_is_one_of_three_words(camera, psf, capture):
    with pytest.raises(rb.InputError, match="self_calibrate"):
        rb.reconstruct(capture.frame, camera, psf, self_calibrate="sometimes")

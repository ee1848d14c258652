"""torch, deepinv and napari, where they are installed."""

import time
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb

GUIDE = Path(__file__).parents[2] / "docs" / "python.md"


def test_torch_gradients_are_the_adjoint(camera, psf, capture):
    torch = pytest.importorskip("torch")
    operator = rb.operator(camera, psf)
    A = operator.to_torch()
    rng = np.random.default_rng(4)
    x = torch.tensor(rng.random((2, 3, *camera.video_shape)), requires_grad=True)
    y = A(x)
    assert y.shape == (2, 3, *camera.frame_shape) and y.dtype == torch.float64
    np.testing.assert_array_equal(y.detach()[1, 2].numpy(), operator(x.detach()[1, 2].numpy()))
    frame = torch.tensor(np.asarray(capture.frame, float))
    loss = 0.5 * ((y - frame) ** 2).sum()
    loss.backward()
    expected = operator.rmatvec((y.detach()[1, 0] - frame).numpy().ravel())
    np.testing.assert_allclose(x.grad[1, 0].numpy().ravel(), expected, rtol=1e-10, atol=1e-12)
    assert A(x.detach().float()).dtype == torch.float32
    small_camera = rb.Camera(rows=4, columns=5, shutter="dual-inside-out", row_time_us=10, exposure_us=25)
    small = rb.operator(small_camera, rng.random((7, 9))).to_torch()
    values = torch.tensor(rng.random(small.video_shape), requires_grad=True)
    assert torch.autograd.gradcheck(small, (values,), eps=1e-3, atol=1e-6)
    assert torch.autograd.gradgradcheck(lambda v: small(v) ** 2, (values,), eps=1e-3, atol=1e-6)
    with pytest.raises(rb.InputError, match="video: found a tensor of shape"):
        A(torch.zeros(3, 3))


def test_deepinv_takes_it_as_a_linear_physics(camera, psf, capture):
    torch = pytest.importorskip("torch")
    pytest.importorskip("deepinv")
    operator = rb.operator(camera, psf)
    physics = operator.to_torch().deepinv()
    x = torch.rand((1, 1, *camera.video_shape), generator=torch.Generator().manual_seed(1))
    # <A x, y> - <x, Aᵀ y>
    assert abs(physics.adjointness_test(x)) < 1e-4 * x.numel()
    assert physics(x).shape == (1, 1, *camera.frame_shape)
    y = torch.tensor(capture.frame)[None, None]
    truth = torch.tensor(capture.truth)[None, None]
    found = physics.A_dagger(y, solver="CG", max_iter=300, tol=1e-4)
    assert torch.linalg.norm(physics.A(found) - y) < 0.1 * torch.linalg.norm(y)
    assert found.shape == truth.shape


def test_without_torch_the_remedy_is_named(camera, psf, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(rb.InputError, match="pip install torch"):
        rb.operator(camera, psf).to_torch()


def test_the_operator_takes_videos_and_vectors(camera, psf, capture):
    A = rb.operator(camera, psf)
    np.testing.assert_array_equal(A(capture.truth).ravel(), A.matvec(capture.truth.ravel()))
    assert A(capture.truth).shape == camera.frame_shape and A(capture.truth.ravel()).ndim == 1


def test_napari_reads_results_archives_and_samples(result, capture, camera, psf, tmp_path):
    from rowburst import _napari

    folder = result.save(tmp_path / "result")
    layers = _napari.get_reader(str(folder))(str(folder))
    video, options, kind = layers[0]
    np.testing.assert_array_equal(video, result.video)
    assert options["units"] == ("microsecond", "pixel", "pixel") and options["axis_labels"] == ("t", "y", "x")
    assert _napari.get_reader(str(folder / "result.json"))(str(folder / "result.json"))[0][1]["name"] == "result: video"
    assert kind == "image" and options["scale"] == (pytest.approx(9.6), 1, 1) and options["metadata"]["rowburst"]["fit"] == result.fit
    assert [layer[1]["name"] for layer in layers] == ["result: video", "result: frame"]
    pytest.importorskip("zarr")
    frames = np.stack([capture.frame, capture.frame])
    rb.batch(frames, tmp_path / "videos.zarr", camera, psf, prior="tv", max_iterations=3)
    archive, options, _ = _napari.get_reader(str(tmp_path / "videos.zarr"))(str(tmp_path / "videos.zarr"))[0]
    assert archive.shape == (2, *camera.video_shape) and len(options["scale"]) == 4
    assert options["units"][1:2] == ["microsecond"] and options["axis_labels"][-2:] == ["y", "x"]
    assert _napari.get_reader(str(tmp_path)) is None
    with pytest.raises(rb.InputError, match="experiment: found"):
        _napari.reconstruct_frame(capture.frame, {})
    (tmp_path / "experiment.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "tv"\n')
    np.save(tmp_path / "psf.npy", psf.array)
    made, options, _ = _napari.reconstruct_frame(capture.frame, {}, tmp_path / "experiment.toml", name="a")
    assert made.shape == camera.video_shape and options["name"].startswith("a: video")
    manifest = Path(rb.__file__).parent / "napari.yaml"
    for line in manifest.read_text().splitlines():
        if "python_name" in line:
            assert callable(getattr(_napari, line.split(":")[-1]))


def test_napari_shows_and_reconstructs_headless(result, tmp_path, monkeypatch):
    """With Qt offscreen, and without a canvas, which would need OpenGL."""
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    pytest.importorskip("napari")
    from napari.components import ViewerModel
    from npe2 import PluginManager
    from qtpy.QtWidgets import QApplication

    from rowburst import _napari

    app = QApplication.instance() or QApplication([])
    PluginManager.instance().discover()
    viewer = ViewerModel()
    folder = result.save(tmp_path / "result")
    # napari reads folders of pictures as well: the plugin is named, as the guide says.
    claims = [reader.command for reader in PluginManager.instance().iter_compatible_readers([str(folder)])]
    assert "rowburst.read" in claims and len(claims) > 1
    assert 'viewer.open("folder", plugin="rowburst")' in GUIDE.read_text(encoding="utf-8")
    layers = viewer.open(str(folder), plugin="rowburst")
    np.testing.assert_array_equal(layers[0].data, result.video)
    assert layers[0].scale[0] == pytest.approx(9.6)
    assert str(layers[0].units[0]) == "microsecond" and layers[0].axis_labels == ("t", "y", "x")
    # Files of other kinds are left to others.
    claims = [reader for reader in PluginManager.instance().iter_compatible_readers(["frame.tif"])]
    assert "rowburst.read" not in [reader.command for reader in claims]
    sample = viewer.open_sample("rowburst", "digits")[0]
    assert sample.data.shape == (108, 108)

    widget = _napari.reconstruct_widget()
    widget.frame.choices = [sample]
    widget.frame.value = sample
    widget.prior.value = "tv"
    made, errors = [], []
    widget.called.connect(lambda worker: (worker.returned.connect(made.append), worker.errored.connect(errors.append)))
    widget.call_button.native.click()
    until = time.monotonic() + 240
    while not made and not errors and time.monotonic() < until:
        app.processEvents()
        time.sleep(0.02)
    assert not errors
    layer = viewer._add_layer_from_data(*made[0])[0]
    assert "video, the fit is" in layer.name and layer.data.shape == (54, 108, 108)
    assert layer.metadata["rowburst"]["prior"] == "tv"

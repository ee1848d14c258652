"""Pictures, labelled axes, folders of results, and what notebooks show."""

import gc
import json
import os
import pickle
import re
import subprocess
import sys
import urllib.request
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    return result.save(tmp_path_factory.mktemp("results") / "result")


@pytest.fixture(scope="module")
def saved(folder):
    return rb.load(folder)


@pytest.fixture(params=["in memory", "of a folder"])
def either(request, result, saved):
    return result if request.param == "in memory" else saved


def test_to_xarray_has_axes_with_units(either, result, camera, capture, psf):
    pytest.importorskip("xarray")
    video = either.to_xarray()
    assert video.dims == ("time", "y", "x") and video.attrs["units"] == "counts"
    np.testing.assert_array_equal(video.values, result.video)
    np.testing.assert_allclose(video.time, camera.time_us, rtol=1e-12)
    assert video.time.attrs["units"] == "µs" and video.y.attrs["units"] == video.x.attrs["units"] == "px"
    np.testing.assert_array_equal(video.x, np.arange(30))
    assert video.attrs["prior"] == result.prior and video.attrs["fit"] == result.fit
    # The first bin starts with the first row's exposure.
    weights = camera.row_time_weights()
    first = weights[np.argmax(weights[:, 0] > 0)]
    assert first[0] == 1 and video.time[0] == camera.row_time_us / 2


def test_the_first_exposure_is_the_zero_of_time(capture, psf, tmp_path):
    pytest.importorskip("xarray")
    # At half a row time the first bin begins half a row time before the first exposure.
    short = rb.Camera(
        rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=4.8, trigger_delay_us=12.5, magnification=0.5
    )
    assert (short.magnification, short.trigger_delay_us) == (0.5, 12.5)
    assert short.time_us[:2] == pytest.approx([0, 9.6])
    result = rb.reconstruct(capture.frame, short, psf, prior="tv", max_iterations=2)
    saved = rb.load(result.save(tmp_path / "result"))
    for each in (result, saved):
        np.testing.assert_allclose(each.time_us, short.time_us, atol=1e-9)
        assert each.numbers["start_us"] == pytest.approx(-4.8)
        assert each.to_xarray().attrs["trigger_delay_us"] == 12.5
        np.testing.assert_allclose(each.to_xarray().time, short.time_us, atol=1e-9)
    for trace in saved.traces():
        np.testing.assert_allclose(trace.time_us, short.time_us, atol=1e-9)


def test_a_larger_field_begins_beside_the_sensor(psf, capture):
    pytest.importorskip("xarray")
    wide = rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, field=(26, 34))
    video = rb.reconstruct(capture.frame, wide, psf, prior="tv", max_iterations=2).to_xarray()
    assert video.y.values[[0, -1]].tolist() == [-1, 24] and video.x.values[[0, -1]].tolist() == [-2, 31]


def test_pictures_show_the_numbers(either, result):
    axes = either.plot()
    assert axes.shape == (2, 2)
    np.testing.assert_array_equal(axes[0, 0].images[0].get_array(), result.video.max(axis=0))
    np.testing.assert_allclose(axes[1, 0].lines[0].get_ydata(), result.video.sum(axis=(1, 2), dtype=float))
    np.testing.assert_array_equal(axes[1, 1].images[0].get_array(), result.residual)
    assert result.fit in axes[0, 0].figure.get_suptitle()

    axes = either.montage(5)
    shown = np.linspace(0, len(result.video) - 1, 5).round().astype(int)
    assert len(axes) == 5
    for ax, bin_ in zip(axes, shown):
        np.testing.assert_array_equal(ax.images[0].get_array(), result.video[bin_])
        assert ax.get_title() == f"{result.time_us[bin_]:.1f} µs"
    assert len(either.montage(1000)) == len(result.video)
    with pytest.raises(rb.InputError, match="frames: found 0"):
        either.montage(0)
    matplotlib.pyplot.close("all")


def test_time_is_a_colour(either, result):
    picture = either.time_colour(cmap="turbo").images[0].get_array()
    colours = matplotlib.colormaps["turbo"](np.linspace(0, 1, len(result.video)))[:, :3]
    tinted = result.video[..., None] / result.video.max() * colours[:, None, None]
    np.testing.assert_allclose(picture, tinted.max(axis=0), atol=1e-5)
    matplotlib.pyplot.close("all")


def test_a_trace_is_drawn_with_its_error(either):
    trace = either.traces()[0]
    ax = trace.plot()
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), trace.debiased)
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), trace.value)
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert np.isclose(band.max(), (trace.debiased + np.nan_to_num(trace.standard_error)).max())
    _, own = matplotlib.pyplot.subplots()
    assert trace.plot(own) is own
    assert len(repr(trace)) < 90 and str(len(trace.value)) in repr(trace)
    matplotlib.pyplot.close("all")


def test_without_matplotlib_the_remedy_is_named(result, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    for call in (result.plot, result.montage, result.time_colour, result.traces()[0].plot):
        with pytest.raises(rb.InputError, match="pip install matplotlib"):
            call()
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(rb.InputError, match="pip install xarray"):
        result.to_xarray()


def test_notebooks_show_tables_and_pictures(either, camera, psf, capture):
    for value, words in (
        (either, [either.prior, "maximum over time", either.fit]),
        (camera, ["dual-inside-out", "9.6 µs", "24×30"]),
        (psf, ["47×59"]),
        (capture, ["counts", "truth, maximum over time"]),
    ):
        page = value._repr_html_()
        for word in words:
            assert word in page, word
        assert "http" not in page and "<script" not in page
    Image = pytest.importorskip("PIL.Image")
    import io

    data = either._repr_html_().split("base64,")[1].split('"')[0]
    picture = np.asarray(Image.open(io.BytesIO(b64decode(data))))
    brightest = either.video.max(axis=0)
    np.testing.assert_array_equal(picture, (255 * (brightest / brightest.astype(float).max())).astype(np.uint8))


def test_a_folder_is_loaded_whole(saved, result, folder):
    for name in ("video", "residual", "excluded", "coverage"):
        np.testing.assert_array_equal(getattr(saved, name), getattr(result, name), err_msg=name)
    assert saved.background is None and not saved.video.flags.writeable
    changing = ("peak_memory_bytes", "trace_errors")
    theirs, ours = saved.numbers, result.numbers
    assert {k: v for k, v in theirs.items() if k not in changing} == {k: v for k, v in ours.items() if k not in changing}
    for a, b in zip(saved.traces(), result.traces(), strict=True):
        assert a.region == b.region and a.numbers["peak"] == b.numbers["peak"]
        np.testing.assert_array_equal(a.debiased, b.debiased)
        np.testing.assert_array_equal(a.standard_error, b.standard_error)
    np.testing.assert_allclose(saved.time_us, result.time_us, rtol=1e-12)
    assert result.fit in repr(saved) and pickle.loads(pickle.dumps(saved)).fit == result.fit
    with pytest.raises(rb.InputError, match="no result.json"):
        rb.load(folder.parent)


def test_the_figure_is_that_of_the_command_line(result, saved, folder, tmp_path):
    for layout in ("fig2", "fig3"):
        figure = result.figure(tmp_path / "figure.svg", layout)
        assert figure.svg.startswith("<?xml") and figure.png[:4] == b"\x89PNG" and len(repr(figure)) < 100
        assert (tmp_path / "figure.svg").read_text(encoding="utf-8") == figure.svg
        assert figure.pdf[:5] == b"%PDF-" and figure.save(tmp_path / "figure.pdf").read_bytes() == figure.pdf
        assert saved.figure(tmp_path / "figure.png", layout).png == (tmp_path / "figure.png").read_bytes()
        assert saved.figure(layout=layout).svg == figure.svg
        program = os.environ.get("ROWBURST")
        if program:
            out = tmp_path / f"{layout}.svg"
            subprocess.run([program, "figure", folder, "--layout", layout, "-o", out], check=True, capture_output=True)
            # Pictures are compressed by another library in a build of its own.
            drawn = [re.sub("base64,[^\"]*", "", text) for text in (out.read_text(encoding="utf-8"), figure.svg)]
            assert drawn[0] == drawn[1] and len(drawn[0]) > 5000
    with pytest.raises(rb.InputError, match="layout"):
        result.figure(layout="fig9")
    with pytest.raises(rb.InputError, match="svg, .pdf or .png"):
        result.figure(tmp_path / "figure.jpg")


def test_the_viewer_shows_the_result_until_it_is_closed(either, result):
    with either.view(port=0, open_browser=False) as view:
        assert view.url in repr(view)
        with urllib.request.urlopen(view.url.replace("/?", "/api/view?"), timeout=20) as answer:
            description = json.load(answer)
        assert result.fit in json.dumps(description)
    with pytest.raises(OSError):
        for _ in range(100):
            urllib.request.urlopen(view.url, timeout=5).close()


def test_a_view_that_nobody_holds_goes_on(result):
    url = result.view(port=0, open_browser=False).url
    gc.collect()
    try:
        # 409 where the files are gone.
        with urllib.request.urlopen(url.replace("/?", "/api/view?"), timeout=20) as answer:
            assert answer.status == 200
    finally:
        for view in [view for view in rb._view._OPEN if view.url == url]:
            view.close()
    assert url not in {view.url for view in rb._view._OPEN}


def test_values_describe_themselves_in_one_line(capture, camera, psf, tmp_path):
    assert repr(capture) == "<rowburst.Simulation: a frame of 24×30, 12 bins of 24×30 in truth>"
    np.save(tmp_path / "psf.npy", psf.array)
    text = camera.to_toml() + '[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "tv"\n'
    (tmp_path / "experiment.toml").write_text(text)
    assert repr(rb.Experiment(tmp_path / "experiment.toml")) == "<rowburst.Experiment: 24×30, prior tv, with psf>"


def test_the_package_is_found_from_its_own_folder():
    """The sources lie in src/, so that python/ does not hide the installed package."""
    here = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", "import rowburst; print(rowburst.__file__)"], cwd=here, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.startswith(str(here))


def test_the_licences_are_installed():
    from importlib.metadata import distribution

    names = {Path(str(f)).name for f in distribution("rowburst").files or []}
    assert {"LICENSE-MIT", "LICENSE-APACHE"} <= names

"""Sources of frames: recordings played back, arrays, and Micro-Manager's core."""

import gc
import json

import numpy as np
import pytest

import rowburst as rb

FRAMES = np.random.default_rng(8).integers(0, 4000, (5, 24, 30)).astype(np.uint16)


class Core:
    """What is used of Micro-Manager's core, with a camera that replays frames."""

    def __init__(self, frames, properties):
        self.frames, self.properties, self.at = frames, properties, -1

    def getCameraDevice(self):
        return "Zyla"

    def getDevicePropertyNames(self, label):
        return tuple(self.properties)

    def getProperty(self, label, name):
        return self.properties[name]

    def getExposure(self):
        return 0.0096

    def getROI(self):
        return [0, 1068, self.frames.shape[2], self.frames.shape[1]]

    def getImageBitDepth(self):
        return 16

    def getDeviceLibrary(self, label):
        return "AndorSDK3"

    def getDeviceName(self, label):
        return "Andor sCMOS Camera"

    def snapImage(self):
        self.at += 1

    def getImage(self):
        return self.frames[self.at % len(self.frames)]


ZYLA = {
    "CameraID": "VSC-01234",
    "OnCameraCCDYSize": "2160",
    "RowReadTime": "9.6e-06",
    "LightScanPlus-SensorReadoutMode": "Centre Out Simultaneous",
    "LightScanPlus-AlternatingReadoutDirection": "Off",
    "ElectronicShutteringMode": "Rolling",
    "Binning": "1x1",
}


def test_a_recording_is_played_back_and_recorded(tmp_path):
    np.save(tmp_path / "frames.npy", FRAMES)
    camera = rb.capture.open(f"play:{tmp_path / 'frames.npy'}?rate=max")
    assert {p.name: p.value for p in camera.settings}["rows"] == "24"
    np.testing.assert_array_equal([frame.image for frame in camera], FRAMES)
    again = rb.capture.open(f"play:{tmp_path / 'frames.npy'}?rate=max")
    record = again.record(tmp_path / "copy.tif", 3)
    assert (record["written"], record["dropped"], record["ended"]) == (3, 0, "complete")
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "copy.tif"), FRAMES[:3])
    # What a record calls dropped is dropped again.
    record["frames"][2]["number"] = 9
    (tmp_path / "copy.json").write_text(json.dumps(record))
    third = rb.capture.open(f"play:{tmp_path / 'copy.tif'}?rate=max")
    assert [frame.number for frame in third] == [0, 1, 9]
    assert third.lost == [(2, 8, "dropped")]
    with pytest.raises(rb.InputError, match="play:PATH"):
        rb.capture.open("camera:0")


def test_the_properties_of_micro_manager_make_an_experiment(tmp_path, camera, psf):
    core = Core(FRAMES, ZYLA)
    capture = rb.capture.from_mmcore(core)
    (tmp_path / "experiment.toml").write_text(capture.experiment)
    read = rb.Experiment(tmp_path / "experiment.toml").camera
    assert (read.rows, read.columns, read.shutter, read.row_time_us) == (24, 30, "dual-inside-out", pytest.approx(9.6))
    assert "# read: RowReadTime = 9.6e-06" in capture.experiment
    assert next(capture).image.dtype == np.uint16
    live = rb.LiveView(read, psf, prior="tv")
    looks = [live.next(frame.image, time_budget_s=0.05) for frame, _ in zip(capture, range(2))]
    assert looks[1].video.shape == camera.video_shape
    record = capture.record(tmp_path / "a.tif", 2)
    assert record["written"] == 2 and record["settings"]["source"] == "mmcore:Zyla"
    assert record["settings"]["camera"] == "AndorSDK3 Andor sCMOS Camera VSC-01234"
    assert record["fingerprint"]["camera"] == record["settings"]["camera"]


def test_what_an_adapter_calculates_is_not_called_read():
    capture = rb.capture.from_mmcore(Core(FRAMES, {"Line Time [us]": "27.77"}))
    assert {p.name: p.origin for p in capture.settings}["Line Time [us]"] == "calculated"
    assert "# calculated: Line Time [us] = 27.77" in capture.experiment


def test_a_global_shutter_is_refused(tmp_path):
    core = Core(FRAMES, {**ZYLA, "ElectronicShutteringMode": "Global"})
    with pytest.raises(rb.InputError, match="rolling shutter"):
        rb.capture.from_mmcore(core).record(tmp_path / "a.tif", 1)
    assert list(tmp_path.iterdir()) == []


def test_a_source_that_fails_keeps_what_it_gave(tmp_path):
    def frames():
        yield from FRAMES[:2]
        raise OSError("unplugged")

    with pytest.raises(OSError, match="unplugged"):
        rb.capture.from_arrays(frames(), {"row_time_us": 9.6}).record(tmp_path / "a.tif")
    record = json.loads((tmp_path / "a.json").read_text())
    assert record["written"] == 2 and "unplugged" in record["ended"]
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "a.tif"), FRAMES[:2])
    with pytest.raises(rb.InputError, match="uint16"):
        next(rb.capture.from_arrays([FRAMES[0] * 0.5]))


@pytest.mark.parametrize("ended", [KeyboardInterrupt(), OSError("unplugged")])
def test_without_a_frame_what_ended_the_source_is_told(tmp_path, ended):
    def frames():
        raise ended
        yield

    with pytest.raises(type(ended)) as found:
        rb.capture.from_arrays(frames(), {"row_time_us": 9.6}).record(tmp_path / "a.tif")
    assert found.value is ended
    assert list(tmp_path.iterdir()) == []


def test_a_captured_frame_is_that_of_its_file(tmp_path, camera, psf):
    np.save(tmp_path / "frame.npy", FRAMES[0])
    frame = next(rb.capture.open(f"play:{tmp_path / 'frame.npy'}"))
    options = {"prior": "tv", "max_iterations": 5}
    of_file = rb.reconstruct(rb.read_frames(tmp_path / "frame.npy")[0], camera, psf, **options)
    np.testing.assert_array_equal(rb.reconstruct(frame.image, camera, psf, **options).video, of_file.video)


@pytest.fixture
def demo_core():
    pymmcore = pytest.importorskip("pymmcore")
    adapters = pytest.importorskip("mm_test_adapters")
    core = pymmcore.CMMCore()
    core.setDeviceAdapterSearchPaths([str(adapters.device_adapter_path())])
    core.loadDevice("Camera", "DemoCamera", "DCam")
    core.initializeDevice("Camera")
    core.setProperty("Camera", "PixelType", "16bit")
    core.setCameraDevice("Camera")
    yield core
    core.reset()


def test_micro_manager_with_its_demo_camera(demo_core):
    capture = rb.capture.from_mmcore(demo_core)
    frames = [next(capture) for _ in range(3)]
    assert [frame.number for frame in frames] == [0, 1, 2]
    assert frames[0].image.shape == (demo_core.getImageHeight(), demo_core.getImageWidth())
    assert capture.reading["exposure_us"] == pytest.approx(1e3 * demo_core.getExposure())
    assert capture.camera.startswith("DemoCamera DCam")


def test_rotation_and_mirrors_of_micro_manager_are_found(demo_core):
    def findings():
        return [finding["name"] for finding in rb.capture.from_mmcore(demo_core).reading["findings"]]

    for name in ("TransposeXY", "TransposeMirrorY", "TransposeMirrorX"):
        demo_core.setProperty("Camera", name, "1")
    # They act where the correction is on.
    assert findings() == []
    demo_core.setProperty("Camera", "TransposeCorrection", "1")
    assert findings() == ["rotated", "mirrored-rows", "mirrored-columns"]


def test_a_sequence_of_micro_manager_tells_dropped_frames(demo_core, tmp_path):
    demo_core.setExposure(2)
    capture = rb.capture.from_mmcore(demo_core, stream=True)
    frames = [next(capture) for _ in range(5)]
    assert [frame.number for frame in frames] == [0, 1, 2, 3, 4]
    times = [frame.time_us for frame in frames]
    assert times == sorted(times) and times[-1] > times[0]
    record = capture.record(tmp_path / "a.tif", 4)
    assert (record["written"], record["dropped"]) == (4, 0)
    assert demo_core.isSequenceRunning()
    # An image that someone else has taken out of the buffer is a gap.
    while demo_core.getRemainingImageCount() == 0:
        pass
    demo_core.popNextImage()
    after = record["frames"][-1]["number"]
    assert next(capture).number == after + 2
    assert capture.lost[-1] == (after + 1, after + 1, "dropped")
    capture.close()
    assert not demo_core.isSequenceRunning()


def test_a_camera_written_in_python_gives_the_bits_of_the_file(camera, psf, capture, tmp_path):
    unicore = pytest.importorskip("pymmcore_plus.experimental.unicore")
    frame = capture.frame
    counts = np.rint(40_000 * frame / frame.max()).astype(np.uint16)

    class RollingShutter(unicore.SimpleCameraDevice):
        """Replays a simulated recording under the properties of Andor's adapter."""

        def __init__(self):
            super().__init__()
            self.exposure = camera.exposure_us / 1e3
            self.register_property("RowReadTime", default_value=camera.row_time_us * 1e-6, is_read_only=True)
            mode = {"dual-inside-out": "Centre Out Simultaneous", "top-down": "Top Down Sequential"}[camera.shutter]
            self.register_property("LightScanPlus-SensorReadoutMode", default_value=mode, is_read_only=True)

        def sensor_shape(self):
            return counts.shape

        def dtype(self):
            return np.uint16

        def get_exposure(self):
            return self.exposure

        def set_exposure(self, exposure):
            self.exposure = exposure

        def snap(self, buffer):
            buffer[:] = counts
            return {}

    core = unicore.UniMMCore()
    core.loadPyDevice("Camera", RollingShutter())
    core.initializeDevice("Camera")
    core.setCameraDevice("Camera")
    source = rb.capture.from_mmcore(core)
    (tmp_path / "experiment.toml").write_text(source.experiment)
    record = source.record(tmp_path / "frame.tif", 1, purpose="frame")
    streamed = rb.capture.from_mmcore(core, stream=True)
    second = next(streamed)
    streamed.close()
    # The core aborts at the end of Python where it is not collected before.
    source.close()
    del source, streamed, core
    gc.collect()
    assert record["written"] == 1
    np.testing.assert_array_equal(second.image, counts)
    read = rb.Experiment(tmp_path / "experiment.toml").camera
    assert (read.rows, read.columns, read.shutter) == (camera.rows, camera.columns, camera.shutter)
    assert read.row_time_us == pytest.approx(camera.row_time_us)
    np.save(tmp_path / "frame.npy", counts)
    # The scale of the truth is that of the counts.
    truth = capture.truth * (40_000 / frame.max())
    options = {"prior": "tv", "max_iterations": 40, "truth": truth}
    of_file = rb.reconstruct(rb.read_frames(tmp_path / "frame.npy")[0], read, psf, **options)
    captured = rb.reconstruct(rb.read_frames(tmp_path / "frame.tif")[0], read, psf, **options)
    np.testing.assert_array_equal(captured.video, of_file.video)
    psnr = [result.numbers["psnr_db"] for result in (captured, of_file)]
    assert psnr[0] == psnr[1] > 20


def test_a_live_view_watches_a_camera(camera, psf, capture):
    counts = np.rint(1000 * capture.frame / capture.frame.max()).astype(np.uint16)
    source = rb.capture.from_arrays([counts, counts], name="bench")
    live = rb.LiveView(camera, psf, prior="tv")
    found = [(frame.number, look.video.shape) for frame, look in source.watch(live, time_budget_s=0.05)]
    assert found == [(0, camera.video_shape), (1, camera.video_shape)]


def test_a_package_without_genicam_says_so():
    try:
        rb.capture.open("genicam:192.0.2.1")
    except rb.InputError as error:
        # With the feature no camera answers at an address that is kept for documents.
        assert "--features genicam" in str(error) or "no answer" in str(error)
    except rb.WorkError as error:
        assert "genicam:192.0.2.1" in str(error)
    else:
        pytest.fail("there is no camera")

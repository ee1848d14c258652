"""Sources of frames: recordings played back, arrays, and Micro-Manager's core."""

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

    def snapImage(self):
        self.at += 1

    def getImage(self):
        return self.frames[self.at % len(self.frames)]


ZYLA = {
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


def test_a_captured_frame_is_that_of_its_file(tmp_path, camera, psf):
    np.save(tmp_path / "frame.npy", FRAMES[0])
    frame = next(rb.capture.open(f"play:{tmp_path / 'frame.npy'}"))
    options = {"prior": "tv", "max_iterations": 5}
    of_file = rb.reconstruct(rb.read_frames(tmp_path / "frame.npy")[0], camera, psf, **options)
    np.testing.assert_array_equal(rb.reconstruct(frame.image, camera, psf, **options).video, of_file.video)


def test_micro_manager_with_its_demo_camera():
    pymmcore = pytest.importorskip("pymmcore")
    adapters = pytest.importorskip("mm_test_adapters")
    core = pymmcore.CMMCore()
    core.setDeviceAdapterSearchPaths([str(adapters.device_adapter_path())])
    core.loadDevice("Camera", "DemoCamera", "DCam")
    core.initializeDevice("Camera")
    core.setProperty("Camera", "PixelType", "16bit")
    core.setCameraDevice("Camera")
    capture = rb.capture.from_mmcore(core)
    frames = [next(capture) for _ in range(3)]
    assert [frame.number for frame in frames] == [0, 1, 2]
    assert frames[0].image.shape == (core.getImageHeight(), core.getImageWidth())
    assert capture.reading["exposure_us"] == pytest.approx(1e3 * core.getExposure())

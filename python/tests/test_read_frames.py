"""Recordings of every kind, and stacks of several channels."""

import numpy as np
import pytest

import rowburst as rb

FRAMES = np.random.default_rng(6).integers(0, 60000, (5, 7, 9)).astype(np.uint16)


def test_folders_stacks_and_zarr_are_read(tmp_path):
    tifffile, zarr = pytest.importorskip("tifffile"), pytest.importorskip("zarr")
    np.save(tmp_path / "stack.npy", FRAMES)
    tifffile.imwrite(tmp_path / "stack.tif", FRAMES)
    tifffile.imwrite(tmp_path / "stack.ome.tif", FRAMES, metadata={"axes": "TYX"})
    (tmp_path / "folder").mkdir()
    for i in (10, 2, 1, 30, 4):
        tifffile.imwrite(tmp_path / "folder" / f"frame{i}.tif", FRAMES[sorted([10, 2, 1, 30, 4]).index(i)])
    for version in (2, 3):
        array = zarr.create_array(tmp_path / f"{version}.zarr", shape=FRAMES.shape, dtype="uint16", zarr_format=version)
        array[...] = FRAMES
    for name in ("stack.npy", "stack.tif", "stack.ome.tif", "folder", "2.zarr", "3.zarr"):
        read = rb.read_frames(tmp_path / name)
        assert read.dtype == np.uint16, name
        np.testing.assert_array_equal(read, FRAMES, err_msg=name)


def test_channels_are_not_taken_for_frames(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    both = np.stack([FRAMES, FRAMES[::-1]], axis=1)
    tifffile.imwrite(tmp_path / "two.ome.tif", both, metadata={"axes": "TCYX"})
    tifffile.imwrite(tmp_path / "two.tif", both, imagej=True, metadata={"axes": "TCYX"})
    for name in ("two.ome.tif", "two.tif"):
        with pytest.raises(rb.InputError, match="2 channels"):
            rb.read_frames(tmp_path / name)
        for channel, expected in ((0, FRAMES), (1, FRAMES[::-1])):
            np.testing.assert_array_equal(rb.read_frames(tmp_path / name, channel=channel), expected)
        with pytest.raises(rb.InputError, match="channel: found 2"):
            rb.read_frames(tmp_path / name, channel=2)
    np.save(tmp_path / "a.npy", FRAMES)
    with pytest.raises(rb.InputError, match="only TIFF"):
        rb.read_frames(tmp_path / "a.npy", channel=0)


def test_frames_of_another_size_are_named(tmp_path):
    np.save(tmp_path / "0.npy", FRAMES[0])
    np.save(tmp_path / "1.npy", FRAMES[1, 1:])
    with pytest.raises(rb.InputError, match="1.npy: found 6×9"):
        rb.read_frames(tmp_path)


class OnlyDlpack:
    """An array that speaks DLPack and nothing else, such as those of some camera drivers."""

    def __init__(self, array):
        self._array = array

    def __dlpack__(self, **options):
        return self._array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._array.__dlpack_device__()


def test_dlpack_objects_are_arrays(capture, camera, psf):
    prior = "tv+0.5*tdiff+support"
    found = rb.reconstruct(OnlyDlpack(capture.frame), camera, OnlyDlpack(psf.array), prior=prior, max_iterations=20)
    expected = rb.reconstruct(capture.frame, camera, psf.array, prior=prior, max_iterations=20)
    np.testing.assert_array_equal(found.video, expected.video)

    class OnDevice(OnlyDlpack):
        def __dlpack__(self, **options):
            raise BufferError("device 2")

    with pytest.raises(rb.InputError, match="device 2.*memory of the processor"):
        rb.reconstruct(OnDevice(capture.frame), camera, psf)

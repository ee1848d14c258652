#!/usr/bin/env python3
"""Checks that Rowburst reads what other programs write.

    python3 scripts/check_inputs.py target/debug/rowburst FOLDER

One small simulated frame and a recording of three are written by the tools of each format (tifffile,
h5py, scipy, astropy, and as Photron packs them), and reconstructed: the videos must be those of the
.npy files to the bit. Metadata must be taken over, and damaged or doubtful files must give exit
status 2 and a clear message. Needs numpy, tifffile, h5py, scipy, astropy and zarr; `scripts/test`
installs them.
"""

import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import tifffile
import zarr
from astropy.io import fits

ROWS, COLUMNS, FRAMES = 24, 20, 3
ROW_US, EXPOSURE_US = 9.6, 19.2
OPTIONS = ["--prior", "tv+support", "--max-iterations", "30"]
CAMERA = f"""[camera]
rows = {ROWS}
columns = {COLUMNS}
shutter = "dual-inside-out"
row_time_us = {ROW_US}
exposure_us = {EXPOSURE_US}
bit_depth = 12
"""
CALIBRATION = '[calibration]\npsf = "psf.npy"\n'
CIHX = """<cih><fileInfo><date>2026/11/22</date></fileInfo>
<recordInfo><recordRate>1000</recordRate><shutterSpeed>52083.333333333336</shutterSpeed></recordInfo>
<frameInfo><totalFrame>{count}</totalFrame></frameInfo>
<imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo>
<imageDataInfo><resolution><width>{columns}</width><height>{rows}</height></resolution>
<colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo>
<effectiveBit><depth>12</depth><side>Lower</side></effectiveBit></imageDataInfo></cih>"""

failures = 0


def check(what, holds, found=""):
    global failures
    print(f"  {'ok  ' if holds else 'FAIL'} {what}" + ("" if holds else f": {found}"))
    failures += not holds


def run(program, *arguments):
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def reconstruct(program, folder, frame, experiment="experiment.toml"):
    """The video, result.json and standard error; or the status and the message."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    status, _, told = run(program, "reconstruct", folder / experiment, "--frame", frame,
                          *OPTIONS, "-o", out)
    if status:
        return None, None, f"{status} {told}"
    return np.load(out / "video.npy"), json.loads((out / "result.json").read_text()), told


def simulated(program, folder):
    """Three 12-bit frames of digits."""
    (folder / "plan.toml").write_text(CAMERA)
    frames = []
    for seed in range(FRAMES):
        out = folder / f"sim{seed}"
        status, _, told = run(program, "simulate", folder / "plan.toml", "--scene", "digits",
                              "--seed", seed + 1, "--snr", 200, "-o", out)
        if status:
            sys.exit(f"simulate: {told}")
        frame = np.load(out / "frame.npy")
        frames.append(np.round(np.clip(frame / frame.max(), 0, 1) * 3000 + 20).astype(np.uint16))
    shutil.copy(folder / "sim0" / "psf.npy", folder / "psf.npy")
    (folder / "experiment.toml").write_text(CAMERA + CALIBRATION)
    return np.array(frames)


def packed12(frames):
    """Two pixels in three bytes, the highest bit first, as a FASTCAM writes them."""
    a, b = frames.reshape(-1, 2).T.astype(np.uint16)
    return np.stack([a >> 4, (a & 15) << 4 | b >> 8, b & 255], axis=1).astype(np.uint8).tobytes()


def photron(path, frames, bits):
    count, rows, columns = frames.shape
    header = CIHX.format(count=count, rows=rows, columns=columns, bits=bits)
    # A binary file with the XML in it.
    path.write_bytes(b"\x00\x01\x02" + header.encode() + b"\x00")
    raw = packed12(frames) if bits == 12 else frames.astype("<u2").tobytes()
    path.with_suffix(".mraw").write_bytes(raw)


def matlab73(path, **variables):
    """As MATLAB's save -v7.3: HDF5 behind a header of 512 bytes, axes turned round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            dataset = file.create_dataset(name, data=np.asarray(value).T, compression="gzip")
            dataset.attrs["MATLAB_class"] = np.bytes_(str(value.dtype))
    with open(path, "r+b") as file:
        text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64"
        file.write(text.ljust(124, b" ") + b"\x00\x02IM")


def write_all(folder, frames):
    """Every format; where `frames` is one frame a 2-D array is written. Yields what it is, and its path."""
    stack = frames if len(frames) > 1 else frames[0]
    frames_last = np.moveaxis(frames, 0, -1) if len(frames) > 1 else frames[0]

    def tif(name, what, **options):
        tifffile.imwrite(folder / name, stack, **options)
        return what, folder / name

    yield tif("a.tif", "TIFF by tifffile", photometric="minisblack", metadata=None)
    yield tif("b.ome.tif", "OME-TIFF", photometric="minisblack", ome=True)
    yield tif("c.tif", "BigTIFF, big-endian", photometric="minisblack", bigtiff=True, byteorder=">")
    yield tif("d.tif", "TIFF deflated in tiles", photometric="minisblack", compression="zlib",
              predictor=True, tile=(16, 16))
    yield tif("e.tif", "ImageJ's TIFF", photometric="minisblack", imagej=True)
    yield tif("f.ome.tif", "OME-BigTIFF", photometric="minisblack", ome=True, bigtiff=True)
    for name, options in [("a.h5", {}), ("b.h5", {"compression": "gzip", "shuffle": True, "chunks": True}),
                          ("c.h5", {"compression": "lzf"}), ("d.h5", {"fletcher32": True})]:
        with h5py.File(folder / name, "w") as file:
            group = file.create_group("run/1")
            group.create_dataset("frames", data=stack, **options)
            file["exposure_us"] = EXPOSURE_US
        yield f"HDF5 by h5py {options or ''}", folder / name
    with h5py.File(folder / "e.h5", "w") as file:
        file["frames"] = stack
        file["dark"] = np.zeros((ROWS, COLUMNS), np.uint16)
    yield "HDF5, named dataset", f"{folder / 'e.h5'}:/frames"
    with h5py.File(folder / "f.h5", "w") as file:
        file["frames"] = stack.astype(">u2")
    yield "HDF5, big-endian", folder / "f.h5"
    for name, deflated in [("a.mat", False), ("b.mat", True)]:
        scipy.io.savemat(folder / name, {"frames": frames_last, "exposure": EXPOSURE_US},
                         do_compression=deflated)
        yield f"MATLAB v5 by scipy, deflated: {deflated}", folder / name
    scipy.io.savemat(folder / "c.mat", {"frames": frames_last, "dark": np.zeros((ROWS, COLUMNS))})
    yield "MATLAB v5, named variable", f"{folder / 'c.mat'}:frames"
    matlab73(folder / "d.mat", frames=frames_last)
    yield "MATLAB v7.3 (HDF5)", folder / "d.mat"
    fits.writeto(folder / "a.fits", stack, overwrite=True)
    yield "FITS by astropy", folder / "a.fits"
    units = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(stack, name="SCI"),
                          fits.ImageHDU(np.zeros((ROWS, COLUMNS), np.uint8), name="MASK")])
    units.writeto(folder / "b.fits", overwrite=True)
    yield "FITS, named extension", f"{folder / 'b.fits'}:SCI"
    photron(folder / "a.cihx", frames, 12)
    yield "Photron, 12 bits packed", folder / "a.cihx"
    photron(folder / "b.cihx", frames, 16)
    yield "Photron, 16 bits", folder / "b.mraw"


def check_frames(program, folder, frame):
    np.save(folder / "frame.npy", frame)
    expected, _, told = reconstruct(program, folder, folder / "frame.npy")
    check("frame.npy is reconstructed", expected is not None, told)
    inputs = folder / "inputs"
    inputs.mkdir()
    for what, path in write_all(inputs, frame[None]):
        video, _, told = reconstruct(program, folder, path)
        check(f"{what}: the video of frame.npy to the bit",
              video is not None and video.tobytes() == expected.tobytes(), told)


def check_recordings(program, folder, frames):
    def videos(path):
        out = folder / "out.zarr"
        shutil.rmtree(out, ignore_errors=True)
        status, _, told = run(program, "batch", folder / "experiment.toml", "--frames", path,
                              *OPTIONS, "-o", out)
        return (None, told) if status else (zarr.open(out, mode="r")["0"][:], told)

    np.save(folder / "frames.npy", frames)
    expected, told = videos(folder / "frames.npy")
    check("frames.npy is done", expected is not None and np.isfinite(expected).all(), told)
    inputs = folder / "stacks"
    inputs.mkdir()
    for what, path in write_all(inputs, frames):
        found, told = videos(path)
        check(f"{what}: the videos of frames.npy to the bit",
              found is not None and found.tobytes() == expected.tobytes(), told)
    # A Micro-Manager folder whose stack goes on in a second file.
    inputs = folder / "mm"
    inputs.mkdir()
    tifffile.imwrite(inputs / "run_MMStack_Pos0.ome.tif", frames[:2], photometric="minisblack")
    tifffile.imwrite(inputs / "run_MMStack_Pos0_1.ome.tif", frames[2:], photometric="minisblack")
    (inputs / "run_MMStack_Pos0_metadata.txt").write_text("{}")
    found, told = videos(inputs)
    check("a stack in two files: the videos of frames.npy to the bit",
          found is not None and found.tobytes() == expected.tobytes(), told)


def check_metadata(program, folder, frame):
    expected, _, _ = reconstruct(program, folder, folder / "frame.npy")
    silent = CAMERA.replace(f"exposure_us = {EXPOSURE_US}\n", "").replace(f"rows = {ROWS}\n", "")
    (folder / "silent.toml").write_text(silent + CALIBRATION)
    inputs = folder / "metadata"
    inputs.mkdir()
    ome = {"axes": "TYX", "SignificantBits": 12, "PhysicalSizeX": 0.65, "PhysicalSizeXUnit": "µm",
           "Plane": {"ExposureTime": [EXPOSURE_US * 1e-6], "ExposureTimeUnit": ["s"]}}
    record = {"Exposure-ms": EXPOSURE_US / 1e3, "ROI": f"0-0-{COLUMNS}-{ROWS}", "Binning": "1",
              "BitDepth": 12, "Core-Camera": "Zyla", "Width": COLUMNS, "Height": ROWS,
              "Zyla-LightScanPlus-SensorReadoutMode": "Centre Out Simultaneous"}
    tag = [(51123, 2, 0, json.dumps(record), True)]
    andor = [(4876, 12, 1, EXPOSURE_US * 1e-6, True)]
    options = {"photometric": "minisblack"}
    tifffile.imwrite(inputs / "ome.ome.tif", frame[None], ome=True, metadata=ome, **options)
    tifffile.imwrite(inputs / "tag.tif", frame, extratags=tag, metadata=None, **options)
    tifffile.imwrite(inputs / "beside.tif", frame, metadata=None, **options)
    (inputs / "beside_metadata.txt").write_text(json.dumps(
        {"Summary": {"Width": COLUMNS, "Height": ROWS}, "FrameKey-0-0-0": record}))
    photron(inputs / "ball.cihx", frame[None], 12)
    header = fits.Header({"EXPTIME": EXPOSURE_US * 1e-6})
    fits.writeto(inputs / "a.fits", frame, header)
    for name in ["ome.ome.tif", "tag.tif", "beside.tif", "ball.cihx", "a.fits"]:
        video, result, told = reconstruct(program, folder, inputs / name, "silent.toml")
        # The exposure, in microseconds, is not the same double from milliseconds or seconds.
        close = video is not None and np.allclose(video, expected, rtol=1e-4, atol=1e-3 * expected.max())
        check(f"{name}: exposure and rows are taken over", close, told)
        if video is not None:
            taken = result["metadata"]["taken"]
            check(f"{name}: result.json says so", {"rows", "exposure_us"} <= set(taken), taken)
    tifffile.imwrite(inputs / "andor.tif", frame, extratags=andor, metadata=None, **options)
    (folder / "sized.toml").write_text(CAMERA.replace(f"exposure_us = {EXPOSURE_US}\n", "") + CALIBRATION)
    video, result, told = reconstruct(program, folder, inputs / "andor.tif", "sized.toml")
    check("Andor's tag: exposure is taken over",
          video is not None and "exposure_us" in result["metadata"]["taken"], told)
    (folder / "other.toml").write_text(CAMERA.replace("19.2", "25.0") + CALIBRATION)
    video, result, told = reconstruct(program, folder, inputs / "tag.tif", "other.toml")
    found = result["warnings"] if video is not None else told
    check("another exposure is warned of", any("exposure_us is 25" in w for w in found), found)
    record["ROI"] = f"0-0-{COLUMNS + 4}-{ROWS}"
    (inputs / "beside_metadata.txt").write_text(json.dumps({"FrameKey-0-0-0": record}))
    refused(program, folder, "a region of another size", inputs / "beside.tif", "columns")


def check_colour(program, folder, frame):
    fits.writeto(folder / "bayer.fits", frame, fits.Header({"BAYERPAT": "RGGB"}))
    out = folder / "colour"
    status, _, told = run(program, "reconstruct", folder / "experiment.toml", "--frame",
                          folder / "bayer.fits", *OPTIONS, "-o", out)
    check("a raw Bayer frame is reconstructed", status == 0, told)
    if status:
        return
    colour = np.load(out / "colour.npy")
    planes = {name: np.load(out / name / "video.npy") for name in ["red", "green-1", "green-2", "blue"]}
    green = (planes["green-1"] + planes["green-2"]) / 2
    joined = np.stack([planes["red"], green, planes["blue"]], axis=-1)
    check("colour.npy: the planes' videos", np.allclose(colour, joined, rtol=1e-6))
    with tifffile.TiffFile(out / "colour.tif") as tiff:
        check("colour.tif: an ImageJ composite, axes TCYX", tiff.is_imagej and tiff.series[0].axes == "TCYX",
              tiff.series[0].axes)
        check("colour.tif: the values of colour.npy",
              np.array_equal(tiff.asarray(), np.moveaxis(colour, -1, 1)))


def refused(program, folder, what, frame, *words):
    video, _, told = reconstruct(program, folder, frame)
    check(f"{what}: exit status 2 and a clear message", video is None and told.startswith("2 ")
          and all(word in told for word in words) and "panic" not in told, told)


def check_bad(program, folder, frame):
    bad = folder / "bad"
    bad.mkdir()
    cut = {"a.tif": 0.6, "b.ome.tif": 0.4, "c.tif": 0.7, "a.h5": 0.8, "a.mat": 0.9, "b.mat": 0.7,
           "d.mat": 0.7, "a.fits": 0.4, "a.mraw": 0.9, "a.cihx": 0.5}
    inputs = folder / "inputs"
    for name, part in cut.items():
        whole = (inputs / name).read_bytes()
        (bad / name).write_bytes(whole[: int(len(whole) * part)])
        if name == "a.cihx":
            continue
        if name == "a.mraw":
            shutil.copy(inputs / "a.cihx", bad / "a.cihx")
        refused(program, folder, f"{name}, cut short", bad / name, name)
    (bad / "a.cihx").write_bytes((inputs / "a.cihx").read_bytes()[:200])
    refused(program, folder, "a.cihx, cut short", bad / "a.cihx", "<cih>")
    refused(program, folder, "HDF5 with several datasets", inputs / "e.h5", "/dark", "/frames")
    refused(program, folder, "HDF5 with a dataset that is not there", f"{inputs / 'e.h5'}:/no", "/no")
    refused(program, folder, "MATLAB with several variables", inputs / "c.mat", "dark", "frames")
    refused(program, folder, "FITS with several images", inputs / "b.fits", "SCI", "MASK")
    with h5py.File(bad / "complex.h5", "w") as file:
        file["frame"] = frame + 1j
    refused(program, folder, "HDF5 with complex numbers", bad / "complex.h5", "/frame")
    with h5py.File(bad / "half.h5", "w") as file:
        file["frame"] = frame.astype(np.float16)
    refused(program, folder, "HDF5 with halves", bad / "half.h5", "/frame")
    with h5py.File(bad / "latest.h5", "w", libver="latest") as file:
        group = file.create_group("many", track_order=True)
        for i in range(20):
            group[f"frame{i}"] = frame
    refused(program, folder, "HDF5 of the latest library, many datasets", bad / "latest.h5", "latest.h5")
    scipy.io.savemat(bad / "text.mat", {"note": "hello", "cells": np.array([1, "a"], object)})
    refused(program, folder, "MATLAB without an image", bad / "text.mat", "note")
    packed = fits.CompImageHDU(frame, compression_type="RICE_1")
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(bad / "rice.fits")
    refused(program, folder, "FITS compressed", bad / "rice.fits", "funpack")
    # tag 259, compression: 50000 is Zstandard.
    bytes_ = bytearray((inputs / "a.tif").read_bytes())
    at = bytes_.index(b"\x03\x01\x03\x00")
    bytes_[at + 8 : at + 10] = (50000).to_bytes(2, "little")
    (bad / "zstd.tif").write_bytes(bytes_)
    refused(program, folder, "TIFF compressed by Zstandard", bad / "zstd.tif", "zstd.tif")
    hole = frame.astype(np.float32)
    hole[3, 4] = np.nan
    tifffile.imwrite(bad / "nan.tif", hole)
    scipy.io.savemat(bad / "nan.mat", {"frame": hole})
    fits.writeto(bad / "nan.fits", hole)
    with h5py.File(bad / "nan.h5", "w") as file:
        file["frame"] = hole
    for name in ["nan.tif", "nan.mat", "nan.fits", "nan.h5"]:
        refused(program, folder, f"{name}, not a number", bad / name, "NaN", "row 3", "column 4")
    stack = np.stack([frame, frame])
    tifffile.imwrite(bad / "two.tif", stack, photometric="minisblack")
    refused(program, folder, "a stack where a frame is meant", bad / "two.tif", "2 pages")


def main(program, folder):
    folder = Path(folder)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    warnings.simplefilter("ignore")
    program = str(Path(program).resolve())
    frames = simulated(program, folder)
    check_frames(program, folder, frames[0])
    check_recordings(program, folder, frames)
    check_metadata(program, folder, frames[0])
    check_colour(program, folder, frames[0])
    check_bad(program, folder, frames[0])
    if failures:
        sys.exit(f"{failures} checks failed in {folder}")
    print(f"  all files in {folder} are read as they should be")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])

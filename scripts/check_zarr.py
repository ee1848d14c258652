#!/usr/bin/env python3
"""Checks archives of `rowburst batch` with programs that Rowburst did not write.

    python3 scripts/check_zarr.py target/debug/rowburst FOLDER

Makes recordings of one small simulated experiment (a folder, a TIFF stack, arrays of Zarr 2 and 3
and an OME-Zarr image), runs batch on each, and reads the archives back with zarr-python,
ome-zarr-py and napari's reader. Needs numpy, tifffile, zarr, ome-zarr and napari-ome-zarr;
`scripts/test` installs them.
"""

import csv
import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import tifffile
import zarr
from napari_ome_zarr import napari_get_reader
from ome_zarr.io import parse_url
from ome_zarr.reader import Reader

FRAMES, ROWS, COLUMNS, BINS = 4, 24, 20, 12
BIN_US, PITCH_UM, PERIOD_US = 9.6, 6.5, 400.0
OPTIONS = ["--prior", "tv+0.5*tdiff+support", "--max-iterations", "60"]

EXPERIMENT = f"""
[camera]
rows = {ROWS}
columns = {COLUMNS}
shutter = "dual-inside-out"
row_time_us = {BIN_US}
exposure_us = {BIN_US}
pixel_pitch_um = {PITCH_UM}

[recording]
frame_period_us = {PERIOD_US}
"""

failures = 0


def check(what, holds, found=""):
    global failures
    print(f"  {'ok  ' if holds else 'FAIL'} {what}" + ("" if holds else f": {found}"))
    failures += not holds


def same(a, b):
    """Equal to the bit, NaN included."""
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def run(program, *arguments):
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"rowburst {' '.join(map(str, arguments))}\n{done.stderr}")
    return done.stdout


def simulate(program, folder):
    """An experiment, and its frames as float32 [frame, y, x]."""
    (folder / "experiment.toml").write_text(EXPERIMENT, encoding="utf-8")
    frames = []
    for seed in range(FRAMES):
        sim = folder / f"sim{seed}"
        psf = ["--psf", folder / "sim0/psf.npy"] if seed else []
        run(program, "simulate", folder / "experiment.toml", "--scene", "moving", "--digit-px", 8,
            "--seed", seed + 1, *psf, "-o", sim)
        frames.append(np.load(sim / "frame.npy"))
    return np.stack(frames)


def recordings(folder, frames):
    """The same frames, in float and as counts, as labs keep them."""
    counts = np.round(frames / frames.max() * 60000).astype(np.uint16)
    # As the name of a format, the values, and the archive that it must equal.
    loose = folder / "loose"
    loose.mkdir()
    for number, frame in enumerate(frames):
        tifffile.imwrite(loose / f"img_{number}.tif", frame)
    yield "folder", loose, "float"
    np.save(folder / "frames.npy", frames)
    yield "npy", folder / "frames.npy", "float"
    tifffile.imwrite(folder / "stack.ome.tif", counts, metadata={"axes": "TYX"})
    yield "stack", folder / "stack.ome.tif", "counts"
    tifffile.imwrite(folder / "big.tif", counts, bigtiff=True, compression="zlib",
                     photometric="minisblack")
    yield "bigtiff", folder / "big.tif", "counts"
    for version, chunks in [(2, (3, ROWS, COLUMNS)), (3, (1, 16, 16))]:
        path = folder / f"v{version}.zarr"
        array = zarr.create_array(path, data=counts, chunks=chunks, zarr_format=version)
        del array
        yield f"zarr{version}", path, "counts"
    sharded = folder / "sharded.zarr"
    zarr.create_array(sharded, data=counts, chunks=(1, 12, 20), shards=(2, 24, 20), zarr_format=3)
    yield "sharded", sharded, "counts"
    image = zarr.open_group(folder / "image.zarr", mode="w", zarr_format=3)
    image.create_array("s0", data=counts[:, None, None], chunks=(2, 1, 1, ROWS, COLUMNS))
    axes = [{"name": "t", "type": "time"}, {"name": "c", "type": "channel"}] + [
        {"name": name, "type": "space"} for name in "zyx"]
    scale = [{"type": "scale", "scale": [1, 1, 1, 1, 1]}]
    datasets = [{"path": "s0", "coordinateTransformations": scale}]
    image.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": datasets}]}
    yield "omezarr", folder / "image.zarr", "counts"


def check_archive(program, folder, out, frames):
    group = zarr.open_group(out, mode="r")
    videos = group["0"]
    check("float32 [frame, t, y, x], a chunk for each frame",
          (videos.dtype, videos.shape, videos.chunks) ==
          (np.float32, (FRAMES, BINS, ROWS, COLUMNS), (1, BINS, ROWS, COLUMNS)), videos.info)
    check("compressed", videos.nbytes_stored() < 0.7 * videos.nbytes, videos.nbytes_stored())
    check("missing chunks are NaN", np.isnan(videos.fill_value), videos.fill_value)
    check("dimension names", videos.metadata.dimension_names == ("frame", "t", "y", "x"))
    for number in range(FRAMES):
        np.save(folder / "one.npy", frames[number])
        alone = folder / "alone"
        run(program, "reconstruct", folder / "experiment.toml", "--frame", folder / "one.npy",
            "--psf", folder / "sim0/psf.npy", *OPTIONS, "--write", "npy,zarr", "-o", alone)
        check(f"frame {number}: the video of rowburst reconstruct, to the bit",
              same(videos[number], np.load(alone / "video.npy")))
    image = group.attrs["ome"]["multiscales"][0]
    axes = {axis["name"]: axis for axis in image["axes"]}
    scale = image["datasets"][0]["coordinateTransformations"][0]["scale"]
    check("units on the axes", [axes[a].get("unit") for a in ("frame", "t", "y", "x")] ==
          ["microsecond", "microsecond", "micrometer", "micrometer"], axes)
    check("scales", scale == [PERIOD_US, BIN_US, PITCH_UM, PITCH_UM], scale)
    origin = image["datasets"][0]["coordinateTransformations"][1]["translation"]
    check("middle of the first bin", origin == [0, BIN_US / 2, 0, 0], origin)
    check("start of each frame",
          same(group["frame_start_us"][:], PERIOD_US * np.arange(FRAMES, dtype=np.float64)))
    with open(out / "rowburst/frames.csv", encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    check("a line for each frame", [row["status"] for row in table] == ["done"] * FRAMES, table)
    check("start times in the table",
          [float(row["start_us"]) for row in table] == [PERIOD_US * i for i in range(FRAMES)])
    return videos[:]


def check_stitched(out, videos):
    group = zarr.open_group(out / "stitched", mode="r")
    stitched, time, frame = group["0"], group["time_us"][:], group["frame"][:]
    dark = np.full((1, ROWS, COLUMNS), np.nan, np.float32)
    parts = [part for video in videos for part in (video, dark)][:-1]
    check("stitched: all videos with a picture of NaN between them",
          np.array_equal(stitched[:], np.concatenate(parts), equal_nan=True), stitched.shape)
    starts = PERIOD_US * np.arange(FRAMES)
    bins = (np.arange(BINS) + 0.5) * BIN_US
    lit = ~np.isnan(frame)
    check("stitched: times of the bins",
          np.allclose(time[lit], (starts[:, None] + bins).ravel(), rtol=1e-12), time)
    check("stitched: times rise", bool((np.diff(time) > 0).all()))
    check("stitched: frames of the bins",
          np.array_equal(frame[lit], np.repeat(np.arange(FRAMES), BINS)), frame)


def check_readers(path, shape, names, units):
    nodes = list(Reader(parse_url(path))())
    check(f"{path.name}: ome-zarr-py finds one image", len(nodes) == 1, nodes)
    check(f"{path.name}: its shape", nodes[0].data[0].shape == shape, nodes[0].data)
    reader = napari_get_reader(str(path))
    layers = [] if reader is None else reader(str(path))
    check(f"{path.name}: napari's reader takes it", len(layers) == 1, layers)
    data, about = layers[0][0], layers[0][1]
    data = data[0] if isinstance(data, (list, tuple)) else data
    check(f"{path.name}: napari's shape", data.shape == shape, data.shape)
    check(f"{path.name}: napari's axes", tuple(about.get("axis_labels", names)) == names, about)
    check(f"{path.name}: napari's units", tuple(about.get("units", units)) == units, about)


def check_tree(out):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        members = sorted(name for name, _ in zarr.open_group(out, mode="r").members())
    check("zarr-python lists it without a warning", not said, [str(w.message) for w in said])
    check("its members", {"0", "frame_start_us", "stitched"} <= set(members), members)


def main():
    program, folder = sys.argv[1], Path(sys.argv[2])
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    frames = simulate(program, folder)
    archives = {}
    for name, path, kind in recordings(folder, frames):
        out = folder / f"out-{name}.zarr"
        summary = json.loads(run(
            program, "batch", folder / "experiment.toml", "--frames", path,
            "--psf", folder / "sim0/psf.npy", *OPTIONS, "--stitch", "--json", "-o", out))
        check(f"{name}: {FRAMES} videos", summary["done"] == FRAMES, summary)
        if kind not in archives:
            source = frames if kind == "float" else tifffile.imread(path)
            archives[kind] = check_archive(program, folder, out, source)
            check_stitched(out, archives[kind])
        check(f"{name}: the videos of the other formats, to the bit",
              same(zarr.open_group(out, mode="r")["0"][:], archives[kind]))
    out = folder / "out-folder.zarr"
    units = ("microsecond", "microsecond", "micrometer", "micrometer")
    check_readers(out, (FRAMES, BINS, ROWS, COLUMNS), ("frame", "t", "y", "x"), units)
    bins = FRAMES * (BINS + 1) - 1
    check_readers(out / "stitched", (bins, ROWS, COLUMNS), ("t", "y", "x"), units[1:])
    check_tree(out)
    image = folder / "alone/video.ome.zarr"
    check("rowburst reconstruct: the image is the video, to the bit",
          same(zarr.open_group(image, mode="r")["0"][:], np.load(folder / "alone/video.npy")))
    check_readers(image, (BINS, ROWS, COLUMNS), ("t", "y", "x"), units[1:])
    if failures:
        sys.exit(f"{failures} checks failed")


main()

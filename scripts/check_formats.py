#!/usr/bin/env python3
"""Checks a demo's files with programs that Rowburst did not write.

    python3 scripts/check_formats.py rowburst-demo

Needs numpy, tifffile, PyAV and Pillow; `scripts/test` installs them.
"""

import base64
import hashlib
import io
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import av
import numpy as np
import tifffile
from PIL import Image

BINS, ROWS, COLUMNS = 54, 108, 108
BIN_S = 9.6e-6

failures = 0


def check(what, holds, found=""):
    global failures
    print(f"  {'ok  ' if holds else 'FAIL'} {what}" + ("" if holds else f": {found}"))
    failures += not holds


def check_npy(folder):
    video = np.load(folder / "video.npy")
    check("video.npy: float32", video.dtype == np.float32, video.dtype)
    check("video.npy: [54, 108, 108], C order",
          video.shape == (BINS, ROWS, COLUMNS) and video.flags.c_contiguous, video.shape)
    check("video.npy: finite, non-negative, not dark",
          bool(np.isfinite(video).all() and video.min() >= 0 and video.max() > 0))
    for name in ["frame.npy", "psf.npy", "truth.npy"]:
        check(f"{name}: finite", bool(np.isfinite(np.load(folder / name)).all()))
    return video


def check_tiff(folder, video):
    with tifffile.TiffFile(folder / "video.tif") as tiff:
        check("video.tif: an ImageJ stack", tiff.is_imagej)
        about = tiff.imagej_metadata or {}
        check("video.tif: 54 frames", about.get("frames") == BINS, about)
        check("video.tif: axes TYX", tiff.series[0].axes == "TYX", tiff.series[0].axes)
        interval = float(about.get("finterval", 0))
        check("video.tif: frame interval 9.6 µs", abs(interval / BIN_S - 1) < 1e-6, interval)
        values = tiff.asarray()
        check("video.tif: the values of video.npy",
              values.dtype == np.float32 and np.array_equal(values, video), values.dtype)
    with tifffile.TiffFile(folder / "without-diffuser.tif") as tiff:
        check("without-diffuser.tif: 108×108", tiff.asarray().shape == (ROWS, COLUMNS))


def check_movie(name, source):
    with av.open(source) as movie:
        stream = movie.streams.video[0]
        context = stream.codec_context
        check(f"{name}: H.264, yuv420p", (context.name, context.pix_fmt) == ("h264", "yuv420p"),
              (context.name, context.pix_fmt))
        check(f"{name}: even sides", context.width % 2 == 0 and context.height % 2 == 0,
              (context.width, context.height))
        frames = [frame.to_ndarray(format="gray") for frame in movie.decode(stream)]
        check(f"{name}: 54 frames decode", len(frames) == BINS, len(frames))
        # The time stands below the picture.
        side = context.width
        check(f"{name}: a strip below the picture", side < context.height < 1.1 * side, context.height)
        lit = sum(frame[:side].max() > 100 for frame in frames)
        check(f"{name}: a digit in most frames", lit > BINS * 0.8, lit)
        strips = [frame[side:, :side // 3].astype(int) for frame in frames]
        check(f"{name}: words in every strip", all(strip.max() > 200 for strip in strips))
        same = sum(abs(a - b).max() < 100 for a, b in zip(strips, strips[1:]))
        check(f"{name}: the words change from frame to frame", same == 0, same)


def check_pictures(folder):
    names = sorted(path.name for path in folder.glob("*.png"))
    check("pictures beside the report", len(names) >= 7, names)
    for name in names:
        try:
            with Image.open(folder / name) as picture:
                picture.load()
                check(f"{name}: decodes, not of one colour", np.asarray(picture).std() > 0)
        except OSError as error:
            check(f"{name}: decodes", False, error)


class Page(HTMLParser):
    """Collects what a page refers to."""

    def __init__(self):
        super().__init__()
        self.references, self.policy, self.scripts = [], None, 0

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.scripts += tag == "script"
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policy = values.get("content")
        for name in ["src", "href", "xlink:href", "srcset", "poster", "data"]:
            if values.get(name):
                self.references.append(values[name])

    handle_startendtag = handle_starttag


def check_report(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    inside = [r for r in page.references if r.startswith("data:")]
    outside = [r[:80] for r in page.references if not r.startswith(("data:", "#"))]
    check("report.html: nothing is fetched", not outside, outside)
    style = re.findall(r"url\((?![\"']?(?:data:|#))[^)]*\)|@import", text)
    check("report.html: no style from outside", not style, style)
    # The viewer's page, where the program has one: its code is let run by its hash, its data is no code.
    scripts = re.findall(r"<script\b([^>]*)>(.*?)</script>", text, re.DOTALL)
    code = [body for about, body in scripts if "application/json" not in about]
    hashes = [base64.b64encode(hashlib.sha256(body.encode()).digest()).decode() for body in code]
    check("report.html: all scripts are found", page.scripts == len(scripts), page.scripts)
    check("report.html: at most one script, let run by its hash", len(code) <= 1 and
          all(f"script-src 'sha256-{value}'" in (page.policy or "") for value in hashes), page.policy)
    check("report.html: a policy that forbids fetching",
          page.policy is not None and "default-src 'none'" in page.policy, page.policy)
    kinds = set()
    for reference in inside:
        kind, _, body = reference.partition(",")
        kinds.add(kind)
        data = base64.b64decode(body, validate=True)
        if kind.startswith("data:image/"):
            with Image.open(io.BytesIO(data)) as picture:
                picture.load()
        elif kind.startswith("data:video/mp4"):
            check_movie("report.html's movie", io.BytesIO(data))
        else:
            check("report.html: a kind of data that is known", False, kind)
    check(f"report.html: its {len(inside)} data URIs decode",
          {"data:image/png;base64", "data:video/mp4;base64"} <= kinds, kinds)


def check_result(folder):
    result = json.loads((folder / "result.json").read_text())
    keys = """version prior tau noise_sigma residual_over_sigma iterations stop_reason seconds
        setup_seconds peak_memory_bytes frames frame_rate_hz threads seed psnr_db ssim""".split()
    missing = [key for key in keys if key not in result]
    check("result.json: all keys", not missing, missing)
    check("result.json: 54 frames at 104,167 Hz",
          result["frames"] == BINS and abs(result["frame_rate_hz"] * BIN_S - 1) < 1e-6)


def main(folder):
    folder = Path(folder)
    video = check_npy(folder)
    check_tiff(folder, video)
    check_movie("video.mp4", str(folder / "video.mp4"))
    check_pictures(folder)
    check_report(folder)
    check_result(folder)
    if failures:
        sys.exit(f"{failures} checks failed in {folder}")
    print(f"  all files of {folder} are as they should be")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])

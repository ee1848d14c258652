#!/usr/bin/env python3
"""docs/demo.png: what a camera records without and with a diffuser, and what comes out.

    cargo run --release -- demo --seed 1 -o rowburst-demo
    python3 scripts/readme_picture.py rowburst-demo docs/demo.png

Needs numpy and Pillow.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

PANEL = 324  # 108 pixels, 3 times enlarged
GAP, TOP, BOTTOM = 18, 30, 34


def first_run(flags):
    """First and last + 1 of the first long run of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(int)))
    return next((a, b) for a, b in zip(edges[::2], edges[1::2]) if b - a > 200)


def panel(path):
    """The first panel of pixels of a figure of the report."""
    picture = Image.open(path).convert("RGB")
    ink = (np.asarray(picture) < 250).any(axis=2)
    # Beside the panel stand a colour bar and texts, above it a title.
    top, bottom = first_run(ink.mean(axis=1) > 0.5)
    left, right = first_run(ink[top:bottom].mean(axis=0) > 0.9)
    cut = picture.crop((left + 1, top + 1, right - 1, bottom - 1))
    # Each pixel of the sensor once, by the middle of its block.
    at = lambda size: ((np.arange(108) + 0.5) * size / 108).astype(int)
    pixels = np.asarray(cut)[at(cut.height)][:, at(cut.width)]
    return Image.fromarray(pixels).resize((PANEL, PANEL), Image.NEAREST)


def colour_bar(path, width, height):
    """The colours of the bar below the panels, from first to last bin."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    below = first_run(((pixels < 250).any(axis=2)).mean(axis=1) > 0.5)[1]
    spread = pixels.max(axis=2) - pixels.min(axis=2)
    rows = [y for y in range(below, len(pixels)) if (spread[y] > 60).mean() > 0.3]
    line = pixels[rows[len(rows) // 2]]
    columns = np.flatnonzero((line.max(axis=1) - line.min(axis=1)) > 60)
    line = line[columns[0] : columns[-1] + 1].astype(np.uint8)
    return Image.fromarray(line[None]).resize((width, height), Image.NEAREST)


def main(folder, output):
    folder = Path(folder)
    panels = [
        ("without the diffuser", panel(folder / "direct.png")),
        ("with the diffuser: the captured frame", panel(folder / "frame.png")),
        ("the video recovered from it, time as colour", panel(folder / "time-colour.png")),
    ]
    picture = Image.new("RGB", (3 * PANEL + 4 * GAP, TOP + PANEL + BOTTOM), "white")
    draw = ImageDraw.Draw(picture)
    font, small = ImageFont.load_default(15), ImageFont.load_default(13)
    for i, (title, image) in enumerate(panels):
        x = GAP + i * (PANEL + GAP)
        draw.text((x + PANEL / 2, TOP / 2), title, "#1b2130", font, anchor="mm")
        picture.paste(image, (x, TOP))
    y = TOP + PANEL + BOTTOM // 2
    bar = colour_bar(folder / "time-colour.png", PANEL - 110, 10)
    picture.paste(bar, (x + 40, y - 5))
    draw.text((x + 34, y), "0", "#1b2130", small, anchor="rm")
    draw.text((x + PANEL - 64, y), "0.52 ms", "#1b2130", small, anchor="lm")
    picture.quantize(255).save(output, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

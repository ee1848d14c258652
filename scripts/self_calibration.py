#!/usr/bin/env python3
"""docs/self-calibration-table.md: frames whose PSF or camera is not quite as given, before and after self-calibration.

    cargo build --release
    python3 scripts/self_calibration.py -o docs/self-calibration-table.md
    python3 scripts/self_calibration.py --quick
    python3 scripts/self_calibration.py --match "digits, scale"
    python3 scripts/self_calibration.py --stand-in --seeds 2

Each row is a frame of 108x108 pixels, simulated without noise and without the fault. The fault is planted here, by
other code than that of the correction: the PSF is resampled by cubic splines in space, its blur is a disc, its noise is
in electrons. Then the program reconstructs with --self-calibrate off and with the default. PSNR is after the best
common factor on the video, since a fault may change the light as a whole.

With --stand-in the frame is that of scripts/real_frames.py in place of a capture, once as it is and once with all faults of
PSF and camera at half their size.

Finished runs are kept in --cache (a folder for each build of the program). Needs numpy, scipy and Pillow: what is
missing is installed by pip into a virtual environment. Progress goes to standard error.
"""

import argparse
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

from common import ROOT, command_line, commit, machine, say, table, with_packages

CACHE = ROOT / "target/self-calibration"
if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(CACHE, __file__, ["numpy", "scipy", "PIL"])

import numpy as np
from real_frames import Bench, digest, photographed, simulated, stand_in, with_noise
from scipy.ndimage import affine_transform
from scipy.signal import fftconvolve

SCENES = ["digits", "moving", "leds"]


# ---------------------------------------------------------------- faults of the PSF


def distorted(psf, scale=0.0, rotation_deg=0.0, anisotropy=0.0, shear=0.0):
    """The PSF stretched, turned and sheared about zero displacement."""
    turn = np.deg2rad(rotation_deg)
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    matrix = matrix @ np.array([[1 + scale + anisotropy, shear], [shear, 1 + scale - anisotropy]])
    inverse, centre = np.linalg.inv(matrix), np.array([side // 2 for side in psf.shape])
    return np.maximum(affine_transform(psf.astype(float), inverse, centre - inverse @ centre, order=3), 0)


def through_pinhole(psf, rms_px):
    """The PSF of a pinhole: a disc whose radius along an axis has this rms."""
    radius, fine = 2 * rms_px, 16
    half = int(np.ceil(radius + 0.5))
    grid = (np.arange((2 * half + 1) * fine) + 0.5) / fine - half - 0.5
    disc = np.hypot(grid[:, None], grid) <= radius
    kernel = disc.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean((1, 3))
    return np.maximum(fftconvolve(psf.astype(float), kernel / kernel.sum(), mode="same"), 0)


def with_floor(psf, fraction):
    """A capture of 8 bits with even light under it, `fraction` of the maximum."""
    return np.round(psf * 255 / psf.max()) + round(255 * fraction)


def mixed(psf, part):
    """The PSF with this part of its light in other speckle: the turned PSF stands for it."""
    return (1 - part) * psf + part * psf[::-1, ::-1]


# ---------------------------------------------------------------- faults of the camera


def place(shape):
    rows, columns = (np.linspace(-1, 1, side) for side in shape)
    return rows[:, None], columns[None]


def vignetted(light, part):
    y, x = place(light.shape)
    return light * (1 - part * (x**2 + y**2) / 2)


def with_stray_light(light, part, slope=0.0):
    _, x = place(light.shape)
    return light + part * light.mean() * (1 + slope * x)


def banded(light, part, rng):
    return light + part * light.mean() * rng.standard_normal((len(light), 1))


def lower_half_brighter(light, part):
    brighter = light.copy()
    brighter[len(light) // 2 :] *= 1 + part
    return brighter


# ---------------------------------------------------------------- faults of the timing


def retimed(made, exposure, longer=0.0, late=0.0):
    """The frame of a dual inside-out sensor whose rows are exposed `longer` row times longer than `exposure`, and whose lower
    half is read `late` row times late."""
    bins, rows, columns = made.truth.shape
    side = [sum(sides) for sides in zip(made.psf.shape, made.truth.shape[1:])]
    scene = np.fft.rfft2(made.truth.astype(float), side)
    optics = np.fft.rfft2(made.psf.astype(float) / made.psf.sum(dtype=float), side)
    top, left = (s // 2 for s in made.psf.shape)
    lead = int(np.ceil(exposure)) - 1
    light = np.empty((rows, columns))
    for row in range(rows):
        is_lower = row >= rows // 2
        end = (row - rows // 2 if is_lower else rows // 2 - 1 - row) + 1 + lead + late * is_lower
        start = end - exposure - longer
        seen = np.maximum(np.minimum(np.arange(1, bins + 1), end) - np.maximum(np.arange(bins), start), 0)
        # Before the first bin the scene is as in this one, after the last as in that.
        seen[0] += max(0, -start)
        seen[-1] += max(0, end - bins)
        image = np.fft.irfft2(np.tensordot(seen, scene, 1) * optics, side)
        light[row] = image[row + top, left : left + columns]
    return light


TIMING_FAULTS = {
    "lower half 0.05 rows late": {"late": 0.05},
    "lower half 0.25 rows late": {"late": 0.25},
    "exposure 0.3 rows longer": {"longer": 0.3},
}
# Changes of PSF and light, each of (array, rng).
FAULTS = {
    "nothing": (None, None),
    "scale 1 %": (lambda p, r: distorted(p, scale=0.01), None),
    "scale 0.3 %": (lambda p, r: distorted(p, scale=0.003), None),
    "rotation 0.3°": (lambda p, r: distorted(p, rotation_deg=0.3), None),
    "anisotropy 0.5 %": (lambda p, r: distorted(p, anisotropy=0.005), None),
    "shear 0.5 %": (lambda p, r: distorted(p, shear=0.005), None),
    "floor 2 %": (lambda p, r: with_floor(p, 0.02), None),
    "pinhole blur 0.5 px": (lambda p, r: through_pinhole(p, 0.5), None),
    "PSF noise 2000 e": (lambda p, r: photographed(p, 2000, r), None),
    "PSF noise 200 e": (lambda p, r: photographed(p, 200, r), None),
    "5 % of the light in other speckle": (lambda p, r: mixed(p, 0.05), None),
    "vignetting 20 %": (None, lambda b, r: vignetted(b, 0.2)),
    "stray light 5 % with a slope": (None, lambda b, r: with_stray_light(b, 0.05, 1)),
    "banding 1 %": (None, lambda b, r: banded(b, 0.01, r)),
    "many at once": (
        lambda p, r: photographed(distorted(p, scale=0.005, rotation_deg=0.2), 2000, r) + 0.02 * p.max(),
        lambda b, r: with_stray_light(vignetted(b, 0.1), 0.03),
    ),
    "scale 2 %": (lambda p, r: distorted(p, scale=0.02), None),
    "rotation 0.6°": (lambda p, r: distorted(p, rotation_deg=0.6), None),
    "pinhole blur 1 px": (lambda p, r: through_pinhole(p, 1), None),
    "vignetting 40 %": (None, lambda b, r: vignetted(b, 0.4)),
    "lower half 3 % brighter": (None, lambda b, r: lower_half_brighter(b, 0.03)),
    **{fault: (None, None) for fault in TIMING_FAULTS},
}
# What the table needs to be read alone.
LEGEND = [
    "The first two columns name the scene and what was made wrong in the PSF or the camera. *off*: PSNR with `--self-calibrate off`; "
    "*default*: PSNR by default, both after the best common factor on the video. *time*: that of the default over that of the "
    "same scene without a fault. *found*: the parameters that the frame has corrected, named and signed as in "
    "[What a frame tells of its own PSF](explanation/self-calibration.md#what-can-be-corrected); `rows` is `row_offsets_counts`.",
    "",
    "Shape and blur of the PSF are found as what undoes the fault: a PSF given 1 % too large has the scale -0.0099. A floor and what "
    "belongs to the camera are found as they are. A floor is made as a part of the PSF's maximum and found as a part of its mean. `PSF noise 2000 e` is the capture of a PSF with 2000 electrons in its "
    "brightest pixel.",
]


def problem(bench, scene, fault, seed, exposure=1):
    """A frame with a planted fault of PSF or camera."""
    made = simulated(bench, scene, exposure, seed)
    change_psf, change_light = FAULTS[fault]
    rng = np.random.default_rng([seed, 4])
    light = retimed(made, exposure, **TIMING_FAULTS[fault]) if fault in TIMING_FAULTS else made.light
    light = change_light(light, rng) if change_light else light
    _, sigma = with_noise(made.light, None, np.random.default_rng([seed, 2]))
    frame = light + np.random.default_rng([seed, 2]).normal(0, sigma, light.shape)
    psf = change_psf(made.psf, rng) if change_psf else made.psf
    return SimpleNamespace(
        camera=made.camera, frame=frame, psf=psf.astype(np.float32), truth=made.truth, planted=np.zeros(frame.shape, bool))


# ---------------------------------------------------------------- table


def scaled_psnr(video, truth):
    """PSNR after the best common factor on the video, in dB."""
    video, truth = video.astype(float), truth.astype(float)
    factor = (video * truth).sum() / max((video**2).sum(), 1e-30)
    return 10 * np.log10(truth.max() ** 2 / np.mean((factor * video - truth) ** 2))


class VideoBench(Bench):
    """A bench that also judges the video itself."""

    def judged(self, made, *more):
        """`result.json` of a run with these options, with the PSNR after the best factor."""
        folder = self.cache / "runs" / digest(made.camera, made.frame, made.psf, more)
        kept = folder / "judged.json"
        if kept.exists():
            return json.loads(kept.read_text())
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "experiment.toml").write_text(made.camera)
        for name in ("frame", "psf"):
            np.save(folder / f"{name}.npy", getattr(made, name).astype(np.float32))
        files = [word for name in ("frame", "psf") for word in (f"--{name}", folder / f"{name}.npy")]
        words = ["reconstruct", folder / "experiment.toml", *files, *more, "--json", "-o", folder / "out"]
        result = json.loads(self.run(*words))
        result["scaled_psnr_db"] = scaled_psnr(np.load(folder / "out/video.npy"), made.truth)
        shutil.rmtree(folder / "out")
        partial_file = kept.with_suffix(".part")
        partial_file.write_text(json.dumps(result))
        partial_file.rename(kept)
        return result


def found(result):
    """What self-calibration says, in a few words."""
    calibration = result["self_calibration"]
    if calibration is None:
        return "nothing"
    words = []
    for name, number in calibration.items():
        if isinstance(number, dict):
            digits = max(0, 1 - int(np.floor(np.log10(max(number["error"], 1e-9)))))
            words.append(f"{name} {number['value']:.{min(digits, 5)}f}")
    if calibration["row_offsets_counts"]:
        words.append("rows")
    if calibration["psf_refinement"]:
        words.append(f"PSF refined by {100 * calibration['psf_refinement']:.0f} %")
    return ", ".join(words)


def table_rows(bench, scenes, faults, seeds, exposure, prior):
    for scene in scenes:
        perfect = {}
        for fault in faults:
            before, after, seconds, words = [], [], [], []
            for seed in range(1, seeds + 1):
                made = problem(bench, scene, fault, seed, exposure)
                off = bench.judged(made, "--prior", prior, "--self-calibrate", "off")
                auto = bench.judged(made, "--prior", prior)
                before.append(off["scaled_psnr_db"])
                after.append(auto["scaled_psnr_db"])
                perfect.setdefault(seed, auto["seconds"] + auto["setup_seconds"])
                seconds.append((auto["seconds"] + auto["setup_seconds"]) / perfect[seed])
                words.append(found(auto))
            say(f"{scene}, {fault}: {np.mean(before):.2f} -> {np.mean(after):.2f} dB, {np.mean(seconds):.1f} times, {words[0]}")
            yield [scene, fault, f"{np.mean(before):.1f}", f"{np.mean(after):.1f}", f"{np.mean(seconds):.1f}", words[0]]


def half_of_all(psf, rng):
    """All faults of a PSF at half their size in the table."""
    psf = distorted(psf, scale=0.005, rotation_deg=0.15, anisotropy=0.0025, shear=0.0025)
    psf = mixed(through_pinhole(psf, 0.25), 0.025)
    return photographed(psf, 4 * 2000, rng) + 0.01 * psf.max()


def half_of_all_light(light, rng):
    return banded(with_stray_light(vignetted(light, 0.1), 0.025, 1), 0.005, rng)


def stand_in_rows(bench, seeds, prior):
    for exposure in (3, 6):
        for seed in range(1, seeds + 1):
            right = bench.judged(stand_in(bench, exposure, seed), "--prior", prior)
            made = stand_in(bench, exposure, seed, half_of_all, half_of_all_light)
            runs = [bench.judged(made, "--prior", prior, "--self-calibrate", how) for how in ("off", "auto", "on")]
            decibels = [run["scaled_psnr_db"] for run in [right, *runs]]
            times = [run["seconds"] + run["setup_seconds"] for run in [right, *runs]]
            cells = [f"{d:.1f} dB, {t:.0f} s" for d, t in zip(decibels, times)]
            say(f"stand-in, {exposure} rows, seed {seed}: {'; '.join(cells)}")
            yield [str(exposure), str(seed), *cells, found(runs[-1])]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--timeout", type=float, default=1800, help="seconds for a run")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--exposure", type=float, default=1, help="in rows")
    parser.add_argument("--prior", default="auto")
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--match", default="", help="only faults that hold this text, and nothing wrong")
    parser.add_argument("--quick", action="store_true", help="three faults of the digits")
    parser.add_argument("--stand-in", action="store_true", help="frames in place of a capture, with all faults at half size")
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    faults = [f for f in FAULTS if f == "nothing" or args.match in f]
    if args.exposure <= 1:
        # A longer exposure of a single bin is a brighter scene.
        faults = [f for f in faults if "longer" not in TIMING_FAULTS.get(f, {})]
    scenes = args.scenes.split(",")
    if args.quick:
        faults, scenes = ["nothing", "scale 1 %", "vignetting 20 %"], ["digits"]
    bench = VideoBench(args.program, args.cache, args.timeout)
    if args.stand_in:
        head = ["exposure in rows", "seed", "right PSF and camera", "faults, off", "auto", "on", "found with on"]
        print(table(head, stand_in_rows(bench, args.seeds, args.prior)))
        return
    head = ["scene", "fault", "off, dB", "default, dB", "time", "found (seed 1)"]
    lines = table(head, table_rows(bench, scenes, faults, args.seeds, args.exposure, args.prior))
    text = "\n".join([
        "# Self-calibration: faults of PSF and camera, before and after", "",
        f"`{command_line('self_calibration.py')}` with {bench.version}, commit {commit()}, {machine()}.", "",
        f"Simulated frames of 108×108 pixels, SNR 256, exposure in row times {args.exposure:g}, prior `{args.prior}`, number of seeds {args.seeds}.", "",
        *LEGEND, "", lines, ""])
    if args.output:
        args.output.write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()

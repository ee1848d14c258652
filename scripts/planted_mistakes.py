#!/usr/bin/env python3
"""Plants mistakes in a small simulated experiment, and checks the first cause that `rowburst reconstruct` names.

    scripts/planted_mistakes.py PROGRAM [NAME]

NAME selects the mistakes whose name holds it. A shutter of the reversed order and an
exposure that is too long are none of them: another video explains the same frame to the noise. The first cause is the first line that begins with `error:` or `warning:`. It
has to match the expression of the mistake. At least 90 % of the mistakes have to be named rightly, and the undisturbed frame
has to be called good. Needs numpy.
"""
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

CAMERA = """[camera]
rows = 40
columns = 40
shutter = "dual-inside-out"
row_time_us = 9.6
exposure_us = 9.6
pixel_pitch_um = 6.5
bit_depth = 16
bias_counts = 100
gain_electrons_per_count = 0.5
read_noise_electrons = 2
full_well_counts = 65000
"""
MIN_RIGHT = 0.9
PSF = r"PSF"
TIMES = r"row times|shutter"


class Bench:
    """A folder with a simulated experiment."""

    def __init__(self, program, folder):
        self.program, self.folder = program, Path(folder)
        (self.folder / "camera.toml").write_text(CAMERA)
        self.run("simulate", "camera.toml", "--scene", "moving", "--digit-px", "8",
                 "--peak-electrons", "20000", "-o", "sim")
        self.experiment = (self.folder / "sim/experiment.toml").read_text()
        self.frame = np.load(self.folder / "sim/frame.npy")
        self.psf = np.load(self.folder / "sim/psf.npy")
        self.counts = np.rint(self.frame).astype(np.uint16)
        self.number = 0

    def run(self, *arguments):
        return subprocess.run([self.program, *arguments], cwd=self.folder, capture_output=True,
                              text=True, timeout=120)

    def first_cause(self, frame=None, psf=None, edit=(), files=(), options=()):
        """The first error or warning of a run with these changes, and its seconds."""
        self.number += 1
        text = self.experiment
        for old, new in edit:
            assert old in text, old
            text = text.replace(old, new)
        arguments = [f"sim/{self.number}.toml"]
        (self.folder / arguments[0]).write_text(text)
        for flag, array in [("--frame", self.counts if frame is None else frame), ("--psf", psf), *files]:
            if array is not None:
                name = f"sim/{self.number}{flag}.npy"
                np.save(self.folder / name, array)
                arguments += [flag, name]
        began = time.perf_counter()
        done = self.run("reconstruct", *arguments, *options, "-o", f"out{self.number}")
        lines = (done.stdout + done.stderr).splitlines()
        causes = [line for line in lines if line.startswith(("error: ", "warning: "))]
        if done.returncode not in (0, 2):
            causes.insert(0, f"exit status {done.returncode}: {lines[-1:]}")
        return causes[0] if causes else "", time.perf_counter() - began


def blurred(psf, width):
    """A PSF out of focus."""
    y, x = np.indices(psf.shape)
    gauss = np.exp(-((y - psf.shape[0] // 2) ** 2 + (x - psf.shape[1] // 2) ** 2) / (2 * width**2))
    product = np.fft.fft2(psf) * np.fft.fft2(np.fft.ifftshift(gauss / gauss.sum()))
    return np.maximum(np.fft.ifft2(product).real, 0).astype(np.float32)


def mistakes(bench):
    """Name, expression of the right first cause, and what is changed."""
    frame, counts, psf = bench.frame, bench.counts, bench.psf
    noise = np.random.default_rng(7)
    hot = counts.copy()
    hot[5, 7] = hot[20, 31] = hot[33, 3] = 60000
    striped = counts.copy()
    striped[:, 12] = 300
    bias, gain = "bias_counts = 100.0", "gain_electrons_per_count = 0.5"
    other = noise.random(psf.shape).astype(np.float32) ** 6
    swapped = counts.byteswap()
    return [
        ("row time in seconds", "row_time_us.*seconds", dict(edit=[("= 9.6", "= 9.6e-6")])),
        ("row time in milliseconds", "row_time_us.*milliseconds", dict(edit=[("= 9.6", "= 9.6e-3")])),
        ("row time in nanoseconds", "row_time_us.*nanoseconds", dict(edit=[("row_time_us = 9.6", "row_time_us = 9600.0"), ("exposure_us = 9.6", "exposure_us = 9600.0")])),
        ("exposure in seconds", "exposure_us.*seconds", dict(edit=[("exposure_us = 9.6", "exposure_us = 9.6e-6")])),
        ("pitch in metres", "pixel_pitch_um.*metres", dict(edit=[("= 6.5", "= 6.5e-6")])),
        ("pitch in millimetres", "pixel_pitch_um.*millimetres", dict(edit=[("= 6.5", "= 6.5e-3")])),
        ("pitch in nanometres", "pixel_pitch_um.*nanometres", dict(edit=[("= 6.5", "= 6500.0")])),
        ("gain of 1e300", "gain_electrons", dict(edit=[(gain, "gain_electrons_per_count = 1e300")])),
        ("binned already", "binning", dict(edit=[("exposure_us = 9.6", "exposure_us = 9.6\nbinning = 2")])),
        ("12 bits", "bit_depth", dict(edit=[("bit_depth = 16", "bit_depth = 12")])),
        ("full well of another gain", "full_well", dict(edit=[("full_well_counts = 65000.0", "full_well_counts = 500.0")])),
        ("8-bit picture", "8-bit", dict(frame=(counts // 256).astype(np.uint8))),
        ("mask as frame", "mask", dict(frame=counts > counts.mean())),
        ("PSF as frame", "PSF", dict(frame=(psf[:40, :40] / psf.max() * 3e4).astype(np.uint16), psf=psf[:40, :40])),
        ("frame as PSF", "the frame itself", dict(psf=frame)),
        ("flat PSF", "flat", dict(psf=np.ones((41, 41), np.float32))),
        ("dark is the frame", "dark", dict(files=[("--dark", counts)])),
        ("dark of another exposure", "dark", dict(files=[("--dark", np.full_like(frame, frame.mean()))])),
        ("bias too large", "bias|dark", dict(edit=[(bias, f"bias_counts = {0.8 * frame.max():.0f}.0")])),
        ("saturated", "saturated", dict(frame=np.full_like(counts, 65535))),
        ("mostly saturated", "saturated", dict(frame=np.minimum(counts.astype(np.int64) * 9, 65535).astype(np.uint16))),
        ("infinite values", "inf|finite", dict(frame=np.full(frame.shape, 1e300))),
        ("transposed", PSF, dict(frame=counts.T.copy())),
        ("upside down", f"{PSF}|{TIMES}", dict(frame=counts[::-1].copy())),
        ("mirrored", PSF, dict(frame=counts[:, ::-1].copy())),
        ("turned by half", PSF, dict(frame=counts[::-1, ::-1].copy())),
        ("bytes swapped", f"{PSF}|byte|saturated", dict(frame=swapped)),
        ("PSF of another diffuser", PSF, dict(psf=other)),
        ("PSF transposed", PSF, dict(psf=psf.T.copy())),
        ("PSF mirrored", PSF, dict(psf=psf[:, ::-1].copy())),
        ("PSF turned by half", PSF, dict(psf=psf[::-1, ::-1].copy())),
        ("PSF out of focus", PSF, dict(psf=blurred(psf, 3))),
        ("PSF with a background", f"{PSF}|floor|background", dict(psf=psf + 0.5 * psf.max())),
        ("shutter top-down", f"{PSF}|{TIMES}", dict(edit=[("dual-inside-out", "top-down")])),
        ("shutter global", f"{PSF}|{TIMES}", dict(edit=[("dual-inside-out", "global")])),
        ("frame shifted by five rows", f"{PSF}|{TIMES}", dict(frame=np.roll(counts, 5, axis=0))),
        ("sigma too small", "σ", dict(options=["--noise-sigma", "15"])),
        ("sigma too large", "σ", dict(options=["--noise-sigma", "4000"])),
        ("gain ten times too large", "gain|σ", dict(edit=[(gain, "gain_electrons_per_count = 50.0")])),
        ("tau too large", "τ|tau", dict(options=["--prior", "tv", "--tau", "20000"])),
        ("tau of 1e300", "tau", dict(options=["--prior", "tv", "--tau", "1e300"])),
        ("stopped after five iterations", "stopped early", dict(options=["--prior", "tv", "--max-iterations", "5"])),
        ("hot pixels kept", "pixel", dict(frame=hot, options=["--keep-all-pixels", "--self-calibrate", "off"])),
        ("dead column kept", "column", dict(frame=striped, options=["--keep-all-pixels", "--self-calibrate", "off"])),
        ("noise alone", "noise|zero", dict(frame=noise.normal(100, 4, frame.shape).clip(0).round().astype(np.uint16))),
    ]


def later_mistakes(bench):
    """Ten more, planted after the causes of the verdict were written (2026-11-25); only the threshold of turned frames is later."""
    counts, psf = bench.counts, bench.psf
    halves = counts.copy()
    halves[:20] = halves[:20][::-1]
    y, x = np.indices(psf.shape)
    centre = (np.array(psf.shape) - 1) / 2
    at = [np.rint(centre[d] + (i - centre[d]) / 1.08).astype(int) for d, i in enumerate((y, x))]
    binned = psf[: psf.shape[0] // 2 * 2, : psf.shape[1] // 2 * 2].reshape(psf.shape[0] // 2, 2, psf.shape[1] // 2, 2).sum((1, 3))
    return [
        ("turned to the left", f"{PSF}|turned", dict(frame=np.rot90(counts).copy())),
        ("even rows, then odd rows", f"{PSF}|{TIMES}", dict(frame=np.concatenate([counts[::2], counts[1::2]]))),
        ("upper half reversed", f"{PSF}|{TIMES}", dict(frame=halves)),
        ("PSF 8 % too large", PSF, dict(psf=psf[at[0], at[1]].copy())),
        ("PSF binned", PSF, dict(psf=binned)),
        ("PSF turned to the left", PSF, dict(psf=np.rot90(psf).copy())),
        ("bias not given", "bias|dark|offset", dict(edit=[("bias_counts = 100.0", "bias_counts = 0.0")])),
        ("gain ten times too small", "gain|σ", dict(edit=[("gain_electrons_per_count = 0.5", "gain_electrons_per_count = 0.05")])),
        ("counts divided by 65535", "bias|dark|zero|unit", dict(frame=(counts / 65535).astype(np.float32))),
        ("gamma of 2.2", f"{PSF}|linear", dict(frame=np.rint(65535 * (counts / 65535) ** (1 / 2.2)).astype(np.uint16))),
    ]


def main(program, part=""):
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(str(Path(program).resolve()), folder)
        cause, good_seconds = bench.first_cause()
        if cause:
            sys.exit(f"the undisturbed frame: {cause}")
        print(f"undisturbed: {good_seconds:.1f} s")
        right = total = 0
        for name, expected, change in mistakes(bench) + later_mistakes(bench):
            if part not in name:
                continue
            cause, seconds = bench.first_cause(**change)
            is_right = re.search(expected, cause) is not None
            right, total = right + is_right, total + 1
            print(f"{'right' if is_right else 'WRONG'}  {name} ({seconds:.1f} s): {cause[:200]}")
        print(f"{right} of {total} mistakes are named rightly")
        if right < MIN_RIGHT * total:
            sys.exit(1)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(*sys.argv[1:])

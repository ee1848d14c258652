"""Videos a second, latency and quality of rowburst live, over digits that move slowly, with their truth:

    python scripts/live_rate.py target/release/rowburst FOLDER [--budget-s 0.05,0.08] [--seconds 10] [--rate 30]

Asks for numpy. The frames are 108×108 of 16 bits, their videos 108×108×54. Run it on an idle machine.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np

FRAMES = 12
#: Largest count of a frame.
COUNTS = 40_000


def recording(program: str, folder: Path) -> np.ndarray:
    """Frames of digits that move, and the truth of each frame in its counts."""
    demo = folder / "demo"
    if not (folder / "truth.npy").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        subprocess.run([program, "demo", "--scene", "digits", "--seed", "1", "-o", demo], check=True, capture_output=True)
        video = np.load(demo / "truth.npy")
        frames, truths = [], []
        for number in range(FRAMES):
            # A pixel in every second frame, there and back, so that the recording is repeated without a jump.
            np.save(folder / "scene.npy", np.roll(video, min(number, FRAMES - number) // 2, 2))
            out = folder / "simulated"
            command = [program, "simulate", demo / "experiment.toml", "--scene", folder / "scene.npy"]
            command += ["--psf", demo / "psf.npy", "--snr", "256", "--seed", str(number), "-o", out]
            subprocess.run(command, check=True, capture_output=True)
            frames.append(np.load(out / "frame.npy"))
            truths.append(np.load(out / "truth.npy"))
            shutil.rmtree(out)
        scale = COUNTS / np.max(frames)
        np.save(folder / "frames.npy", np.rint(np.clip(np.multiply(frames, scale), 0, None)).astype(np.uint16))
        np.save(folder / "truth.npy", np.multiply(truths, scale).astype(np.float32))
    return np.load(folder / "truth.npy")


class Page:
    """What the page of rowburst live asks."""

    def __init__(self, program: str, folder: Path, budget_s: float, rate: float) -> None:
        source = f"play:{folder / 'frames.npy'}?rate={rate}&loop"
        command = [program, "live", folder / "demo/experiment.toml", "--psf", folder / "demo/psf.npy"]
        command += ["--source", source, "--time-budget-s", str(budget_s), "--port", "0", "--no-open", "-o", folder / "kept"]
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        found = None
        while not found:
            line = self.child.stdout.readline()
            if not line:
                raise SystemExit("rowburst live has ended")
            found = re.search(r"(http://[0-9.:]+)/\?(token=[0-9a-f]+)", line)
        self.address, self.token = found.groups()

    def ask(self, path: str) -> tuple[bytes, str]:
        with urllib.request.urlopen(f"{self.address}/api/monitor{path}?{self.token}", timeout=10) as answer:
            return answer.read(), answer.headers.get("x-range", "0 1")

    def state(self) -> dict:
        return json.loads(self.ask("")[0])

    def video(self) -> np.ndarray:
        data, scale = self.ask("/bins")
        low, high = map(float, scale.split())
        return low + np.frombuffer(data, "<u2") * ((high - low) / 65534)

    def close(self) -> None:
        self.child.send_signal(signal.SIGINT)
        self.child.wait(timeout=30)


def psnr(video: np.ndarray, truth: np.ndarray) -> float:
    error = np.mean((video - truth.ravel()) ** 2)
    return float(10 * np.log10(truth.max() ** 2 / error))


def measure(page: Page, truth: np.ndarray, seconds: float) -> tuple[list[float], list[dict]]:
    """PSNR of the videos that could be fetched, and the states of the solver."""
    found, states, last = [], [], None
    # The first videos begin from nothing.
    end = time.monotonic() + seconds + 3
    while time.monotonic() < end:
        state = page.state()
        video = state.get("video")
        if video and video["number"] != last and end - time.monotonic() < seconds:
            last = video["number"]
            pixels = page.video()
            after = page.state()
            # The video may have been replaced while it was fetched.
            is_same = after["video_snapshot"] == state["video_snapshot"] and after["video"]["number"] == last
            if is_same:
                found.append(psnr(pixels, truth[last % len(truth)]))
            states.append(video)
        time.sleep(0.02)
    return found, states


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", type=os.path.realpath)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--budget-s", default="0.05,0.07,0.1")
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--rate", type=float, default=30, help="frames a second that the camera gives")
    options = parser.parse_args()
    folder = options.folder.resolve()
    truth = recording(options.program, folder)
    print("| budget s | videos a second | latency ms | PSNR dB, median | least | warm |")
    print("|---|---|---|---|---|---|")
    for budget in map(float, options.budget_s.split(",")):
        page = Page(options.program, folder, budget, options.rate)
        try:
            found, states = measure(page, truth, options.seconds)
        finally:
            page.close()
        rate = np.median([s["videos_per_second"] for s in states])
        latency = np.median([s["latency_ms"] for s in states])
        warm = np.mean([s["warm_start"] for s in states])
        print(f"| {budget:g} | {rate:.1f} | {latency:.0f} | {np.median(found):.1f} | {min(found):.1f} | {100 * warm:.0f} % |")
    print(f"load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors")


if __name__ == "__main__":
    main()

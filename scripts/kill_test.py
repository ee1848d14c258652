#!/usr/bin/env python3
"""Kills commands at random moments, and checks that nothing is lost.

    scripts/kill_test.py PROGRAM [--times N] [--seed S] [--only NAME]

Each of reconstruct, reconstruct --part-bins, batch and calibrate is run N times (100) and ended by `kill -9`: at a random
moment, and every third time while a file is being written. Afterwards every file must be whole, and the same command must
go on and end with the files of an undisturbed run, to the bit. What differs between two undisturbed runs, such as times,
does not count. Needs numpy.
"""
import argparse
import json
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

CAMERA = """[camera]
rows = 24
columns = 24
shutter = "dual-inside-out"
row_time_us = 10
exposure_us = 10
"""
FRAME = "reconstruct sim/experiment.toml --frame sim/frame.npy --self-calibrate off --keep-all-pixels --max-iterations 15"
COMMANDS = {
    "reconstruct": f"{FRAME} --prior tv+0.5*tdiff -o",
    "part-bins": f"{FRAME} --prior tv --part-bins 1 -o",
    "batch": "batch sim/experiment.toml --frames rec --prior tv+0.5*tdiff --max-iterations 15 --self-calibrate off -o",
    "calibrate": "calibrate sensor --darks darks --flats flats -o",
}
# The list of files has times and temporary names.
LIST = ".rowburst-files"


class Bench:
    """A folder with the inputs of all commands."""

    def __init__(self, program, folder):
        self.program, self.folder = program, Path(folder)
        (self.folder / "camera.toml").write_text(CAMERA)
        self.finish(["simulate", "camera.toml", "--scene", "digits", "--digit-px", "8", "--seed", "2", "-o", "sim"])
        for name in ("rec", "darks", "flats"):
            (self.folder / name).mkdir()
        noise = np.random.default_rng(5)
        frame = np.load(self.folder / "sim/frame.npy")
        for i in range(8):
            level = noise.normal(0, 0.01 * frame.std(), frame.shape)
            np.save(self.folder / f"rec/f{i}.npy", (frame + level).astype(np.float32))
        for i in range(10):
            dark = noise.normal(100, 3, (48, 48)).round().clip(0)
            light = noise.poisson(2000, (48, 48)) / 2
            np.save(self.folder / f"darks/d{i}.npy", dark.astype(np.uint16))
            np.save(self.folder / f"flats/f{i}.npy", (dark + light).round().astype(np.uint16))

    def arguments(self, command, out):
        """The arguments of `command`, with the files of a folder in its place."""
        words = []
        for word in command.split():
            is_folder = word in ("darks", "flats")
            words += sorted(str(p.relative_to(self.folder)) for p in (self.folder / word).iterdir()) if is_folder else [word]
        return [*words, out]

    def start(self, arguments):
        return subprocess.Popen([self.program, *arguments], cwd=self.folder, stdout=subprocess.DEVNULL,
                                stderr=subprocess.PIPE, text=True)

    def finish(self, arguments):
        """Runs a command that must succeed; its seconds."""
        began = time.perf_counter()
        process = self.start(arguments)
        _, errors = process.communicate(timeout=300)
        if process.returncode:
            raise AssertionError(f"{' '.join(arguments)}\nexit status {process.returncode}: {errors}")
        return time.perf_counter() - began


def is_temporary(path):
    """Whether a file is not whole yet: hidden, or one that is filled step by step."""
    return path.name.endswith(".part") or "tmp" in path.parts


def files_of(folder):
    """All files that have their names, by their paths."""
    paths = (p for p in sorted(folder.rglob("*")) if p.is_file())
    found = {str(p.relative_to(folder)): p for p in paths if not is_temporary(p.relative_to(folder))}
    return {name: path for name, path in found.items() if Path(name).name not in (LIST, "lock", "choice.lock")}


def temporaries(folder):
    """The files that are being written, but for the one that a job fills step by step."""
    names = set()
    for place in (folder, folder / "rowburst/tmp"):
        try:
            for path in place.rglob("*") if place.name == "tmp" else place.iterdir():
                if (path.name.startswith(".") and path.name.endswith(".part")) or (place.name == "tmp" and path.name.startswith(".tmp")):
                    names.add(str(path))
        except OSError:
            pass
    return names


def is_fleeting(key, value):
    """Whether a leaf is a time or a memory, which two runs may have in common by chance."""
    return re.search("seconds|memory|date|frames_per", key) or re.search(r"\d (s|ms|MB|GB)\b", str(value))


def flat(value, path=""):
    """The leaves of a JSON value that do not depend on the moment."""
    if isinstance(value, dict):
        return {k: v for key, part in value.items() for k, v in flat(part, f"{path}/{key}").items()}
    if isinstance(value, list):
        return {k: v for i, part in enumerate(value) for k, v in flat(part, f"{path}/{i}").items()}
    return {} if is_fleeting(path, value) else {path: value}


def check_whole(name, path):
    """Fails where a file is cut off."""
    data = path.read_bytes()
    end = Path(name).suffix
    if end == ".npy":
        np.load(path)
    elif end == ".json":
        json.loads(data)
    elif end == ".png":
        assert data.endswith(b"IEND\xaeB`\x82"), name
    elif end == ".html":
        assert data.rstrip().endswith(b"</html>"), name
    elif end in (".csv", ".toml"):
        assert data.endswith(b"\n"), name
    elif end == ".mp4":
        at = 0
        while at < len(data):
            at += int.from_bytes(data[at:at + 4], "big")
        assert at == len(data), name


class Calm:
    """What two undisturbed runs agree on."""

    def __init__(self, bench, command):
        folders = [bench.folder / f"calm{i}" for i in range(2)]
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)
        self.seconds = min(bench.finish(bench.arguments(command, folder.name)) for folder in folders)
        one, other = (files_of(folder) for folder in folders)
        assert one.keys() == other.keys(), one.keys() ^ other.keys()
        self.names = set(one)
        self.bytes, self.leaves = {}, {}
        for name, path in one.items():
            # The folder's own name is in commands.
            data = [content(p).replace(b"calm0", b"OUT").replace(b"calm1", b"OUT") for p in (path, other[name])]
            if data[0] == data[1]:
                self.bytes[name] = data[0]
            elif path.suffix == ".json":
                leaves = [flat(json.loads(text)) for text in data]
                same = leaves[0].items() & leaves[1].items() if all_hashable(leaves) else set()
                self.leaves[name] = dict(same)
        assert any(name.endswith((".npy", ".tif")) or "/c/" in name for name in self.bytes), sorted(self.bytes)

    def compare(self, folder):
        """Fails where `folder` differs from an undisturbed run."""
        files = files_of(folder)
        assert files.keys() == self.names, f"files differ: {files.keys() ^ self.names}"
        mark = folder.name.encode()
        for name, data in self.bytes.items():
            assert content(files[name]).replace(mark, b"OUT") == data, f"{name} differs"
        for name, leaves in self.leaves.items():
            found = flat(json.loads(files[name].read_bytes().replace(mark, b"OUT")))
            for key, value in leaves.items():
                assert found.get(key) == value, f"{name}: {key} is {found.get(key)}, not {value}"


def content(path):
    """The bytes of a file; a table without its seconds, which two undisturbed runs may have alike by chance."""
    data = path.read_bytes()
    if path.suffix != ".csv":
        return data
    rows = [line.split(b",") for line in data.splitlines()]
    kept = [at for at, name in enumerate(rows[0]) if name != b"seconds"]
    return b"\n".join(b",".join(row[at] for at in kept if at < len(row)) for row in rows)


def all_hashable(values):
    return all(isinstance(v, (str, int, float, bool, type(None))) for leaves in values for v in leaves.values())


def kill_at(process, moment):
    """Waits until `moment` seconds have passed, then kills; whether the process was still running."""
    try:
        process.wait(timeout=moment)
        return False
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.wait()
        return True


def kill_while_writing(process, folder, target):
    """Kills while the `target`th file is being written; whether that came to be."""
    seen = set()
    while process.poll() is None:
        seen |= temporaries(folder)
        if len(seen) >= target:
            process.send_signal(signal.SIGKILL)
            process.wait()
            return True
    return False


def test(bench, name, times, chance):
    """Kills one command `times` times."""
    command = COMMANDS[name]
    calm = Calm(bench, command)
    folder = bench.folder / "killed"
    arguments = bench.arguments(command, folder.name)
    written = max(2, len(calm.names))
    killed = writing = left = 0
    while killed < times:
        shutil.rmtree(folder, ignore_errors=True)
        process = bench.start(arguments)
        is_writing = killed % 3 == 2
        if is_writing:
            is_killed = kill_while_writing(process, folder, chance.randint(1, written))
        else:
            is_killed = kill_at(process, chance.uniform(0, 1.1 * calm.seconds))
        process.stderr.close()
        if not is_killed:
            # It was done before; a file that is written in no time may not be seen.
            written = max(2, written - 1) if is_writing else written
            continue
        killed += 1
        writing += is_writing
        left += bool(folder.exists() and temporaries(folder))
        for file, path in files_of(folder).items() if folder.exists() else ():
            check_whole(file, path)
        bench.finish(arguments)
        calm.compare(folder)
        assert not temporaries(folder), f"left over: {temporaries(folder)}"
        assert not (folder / "video.npy.part").exists() and not (folder / "parts.json").exists()
    print(f"{name}: killed {killed} times, {writing} of them on sight of a file being written; "
          f"{left} left a file half written; a run takes {calm.seconds:.2f} s", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("--times", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=COMMANDS)
    given = parser.parse_args()
    chance = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(str(Path(given.program).resolve()), folder)
        for name in COMMANDS:
            if given.only in (None, name):
                test(bench, name, given.times, chance)


if __name__ == "__main__":
    try:
        main()
    except AssertionError as failure:
        sys.exit(f"kill_test: {failure}")

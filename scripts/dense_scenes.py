#!/usr/bin/env python3
"""The numbers of docs/dense-scenes.md and of docs/design/028: dense scenes without a guide, and with honest and false ones.

    python3 scripts/dense_scenes.py
    python3 scripts/dense_scenes.py --scenes still,bench,beam,wheel,cells --guides none
    python3 scripts/dense_scenes.py --scenes bench --rows 1 --seeds 33 --guides honest,mirrored,noise

Builds and runs the example `dense_scenes` of the library and prints its lines as a table. Without a guide ("none") the
program chooses the prior, and "of_sparse" is the time over that for digits of 12 px in the same run. "path_px" is the rms distance
of the object of bench from its place in the truth. The guides honest, timed,
keys, blurred, dim, noisy, first, last and exact belong to the frame; same-kind, mirrored, flipped, turned, larger,
smaller, half, overexposed, noise, other-bench, other-cells and other-beam do not.
"""

import argparse
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HONEST = {"honest", "timed", "keys", "blurred", "dim", "noisy", "first", "last", "exact"}
COLUMNS = ["scene", "rows", "seed", "guide", "used", "model", "psnr_db", "mean_db", "held_out", "without", "correlation",
           "path_px", "seconds", "of_sparse"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="bench,beam,wheel,cells")
    parser.add_argument("--rows", default="1,6", help="exposures in rows")
    parser.add_argument("--seeds", default="31,32,34")
    parser.add_argument("--guides", default="honest,timed")
    parser.add_argument("--program", type=Path, help="the example, if it is built, such as target/debug/examples/dense_scenes")
    args = parser.parse_args()
    words = ["cargo", "run", "--release", "--quiet", "-p", "rowburst", "--example", "dense_scenes", "--"]
    words = [args.program] if args.program else words
    words += [args.scenes, args.rows, args.seeds, args.guides]
    process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    names = next(process.stdout).rstrip().split("\t")
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    wrong = {"honest ones dropped": 0, "false ones used": 0}
    for line in process.stdout:
        case = dict(zip(names, line.rstrip().split("\t")))
        print("| " + " | ".join(case[name] for name in COLUMNS) + " |", flush=True)
        is_honest = case["guide"] in HONEST
        wrong["honest ones dropped"] += is_honest and case["used"] == "false"
        wrong["false ones used"] += not is_honest and case["used"] == "true"
    print("\n" + ", ".join(f"{name}: {count}" for name, count in wrong.items()))
    return process.wait()


if __name__ == "__main__":
    sys.exit(main())

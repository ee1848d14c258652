#!/usr/bin/env python3
"""Checks that a source distribution holds what its build and its users need, and nothing that is large or not ours.

    python3 scripts/check_sdist.py target/sdists/rowburst-0.2.0.tar.gz
"""

import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MAX_BYTES = 8_000_000


def main():
    with tarfile.open(sys.argv[1]) as archive:
        members = [member for member in archive.getmembers() if member.isfile()]
    names = {member.name.split("/", 1)[1] for member in members}
    package = {path.name for path in (ROOT / "python/src/rowburst").iterdir() if path.suffix in (".py", ".pyi", ".yaml", ".typed")}
    wanted = {"pyproject.toml", "PKG-INFO", "Cargo.lock"}
    faults = [f"no {name}" for name in wanted if name not in names]
    for ending in ["build_backend/rowburst_build.py", "LICENSE-MIT", "LICENSE-APACHE", "py.typed", *sorted(package)]:
        if not any(name.endswith(ending) for name in names):
            faults.append(f"no {ending}")
    # The crates that the extension is built of, and the viewer's page, which needs no Node.js.
    manifests = {path.parent.name for path in (ROOT / "crates").glob("*/Cargo.toml")}
    faults += [f"no crate {name}" for name in manifests if not any(f"{name}/Cargo.toml" in n for n in names)]
    faults += [f"foreign file {name}" for name in names if "__pycache__" in name or name.endswith((".so", ".pyc"))]
    size = sum(member.size for member in members)
    if size > MAX_BYTES:
        faults.append(f"{size} bytes, more than {MAX_BYTES}")
    if faults:
        sys.exit("check_sdist.py: " + "; ".join(sorted(faults)))
    print(f"{sys.argv[1]}: {len(names)} files, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()

"""What the scripts share: packages from pip, what is said of a run, tables."""

import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Modules, and what pip calls them.
PACKAGES = {m: m for m in ("numpy", "scipy", "pylops", "pyproximal", "matplotlib")} | {
    "PIL": "pillow", "scico": "scico==0.0.7"}


def say(*words):
    print(*words, file=sys.stderr, flush=True)


def with_packages(cache, script, modules):
    """Runs `script` again in an environment that has `modules`, where this one has not."""
    import importlib.util

    missing = [m for m in modules if not importlib.util.find_spec(m)]
    if not missing:
        return
    venv = cache / "venv"
    python = venv / "bin" / "python"
    packages = [PACKAGES[m] for m in missing]
    in_venv = Path(sys.prefix).resolve() == venv.resolve()
    if not python.exists():
        say(f"making a virtual environment in {venv}")
        subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    if in_venv or not all((venv / f"has-{m}").exists() for m in modules):
        if in_venv and os.environ.get("ROWBURST_VENV") == "tried":
            sys.exit(f"{Path(script).name}: pip did not bring {', '.join(missing)}")
        os.environ["ROWBURST_VENV"] = "tried"
        packages = [PACKAGES[m] for m in modules]
        say(f"installing {', '.join(packages)} into {venv}")
        subprocess.run([python, "-m", "pip", "--quiet", "--disable-pip-version-check", "install", *packages], check=True)
        for m in modules:
            (venv / f"has-{m}").touch()
    os.execv(python, [str(python), str(script), *sys.argv[1:]])


def command_line(script):
    """What was typed, but for places of files, which change nothing."""
    words, kept = sys.argv[1:], []
    while words:
        word = words.pop(0)
        if word.split("=")[0] in ("--program", "--cache", "--shared", "-o", "--output"):
            words = words if "=" in word else words[1:]
        else:
            kept.append(word)
    return shlex.join(["python3", f"scripts/{script}", *kept])


def commit():
    """The commit of the sources, and whether the program's have been changed since."""
    git = lambda *words: subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    changed = git("status", "--porcelain", "crates", "Cargo.toml", "Cargo.lock")
    return git("describe", "--always") + (", changed" if changed else "")


def table(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def machine():
    name = platform.machine()
    try:
        name = next(l.split(":", 1)[1].strip() for l in open("/proc/cpuinfo") if l.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{name}, {os.cpu_count()} threads"

"""The script of a user, on this Python."""

import subprocess
import sys
from pathlib import Path


def test_a_user_needs_no_command_line(tmp_path):
    script = Path(__file__).parent / "user_script.py"
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "done; left out:" in done.stdout

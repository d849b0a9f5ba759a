"""Run a study of a finished decision as it was: ``python tests/studies/at_commit.py COMMIT STUDY [WORDS ...]``.

The figures of such a decision are those of the code of its day. The commit is checked out into a temporary folder
with the recordings beside it, and the study runs on the commit's own source, with the kernels compiled for it; files
that its words name are those of the folder in which it is called.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import paths


def main() -> None:
    """Check out the commit, run the study with its words, and remove the folder; the exit code is the study's."""
    if len(sys.argv) < 3:
        sys.exit("name a commit and a study, for example: at_commit.py 7acc6e0c tunnel_score")
    commit, study, *words = sys.argv[1:]
    git = ["git", "-C", str(paths.ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "railfix"
        (Path(name) / "shared").symlink_to(paths.DATA.parent)
        subprocess.run([*git, "add", "--detach", "--quiet", str(folder), commit], check=True)
        try:
            environment = {**os.environ, "PYTHONPATH": str(folder / "src")}
            command = [sys.executable, str(folder / "tests" / "studies" / f"{study}.py"), *words]
            done = subprocess.run(command, env=environment, check=False)
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=True)
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()

"""Build hook of hatchling: the commit, as ``railfix/_commit.txt`` in wheels, ``.ci/commit.txt`` in source archives."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Final

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

#: Where a source archive has the commit, and where a wheel has it.
PLACES: Final = {"sdist": ".ci/commit.txt", "wheel": "railfix/_commit.txt"}


class CommitHook(BuildHookInterface):
    """Writes the commit of a checkout, or of the source archive; editable installs read git's files when they run."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the file with the commit to what is packed."""
        self.folder = Path(tempfile.mkdtemp())
        archived = Path(self.root) / PLACES["sdist"]
        if version == "editable" or not ((Path(self.root) / ".git").exists() or archived.is_file()):
            return
        path = self.folder / "commit.txt"
        if archived.is_file():
            shutil.copy(archived, path)
        else:
            try:
                changed = "+changed" if self._git("status", "--porcelain") else ""
                path.write_text(f"{self._git('rev-parse', 'HEAD')}{changed}\n", encoding="ascii")
            except (OSError, subprocess.CalledProcessError) as error:
                self.app.display_warning(f"the commit stays unknown: {error}")
                return
        build_data["force_include"][str(path)] = PLACES[self.target_name]

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Remove the file again."""
        shutil.rmtree(self.folder)

    def _git(self, *words: str) -> str:
        command = ["git", "-C", self.root, *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

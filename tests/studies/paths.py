"""The repository and the recordings beside it; importing it puts the folders of the tests on the path of imports."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
#: Folder of the real recordings, which are not part of the repository.
DATA: Final = ROOT.parent / "shared" / "data"

sys.path[:0] = [str(folder) for folder in sorted((ROOT / "tests").iterdir()) if folder.is_dir()]

"""The demonstration with the lowest and the newest versions of the dependencies is that of this environment."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dependency_versions import MOST, RESOLUTIONS, TABLES, compare


def results(folder: Path, *, arc_m: str = "12.3450", status: str = "ok") -> Path:
    folder.mkdir()
    for name in TABLES:
        (folder / name).write_text(f"time_gpst,chainage_m,status\n2026-05-12T10:00:00,{arc_m},{status}\n", "utf-8")
    return folder


def test_what_differs_is_found(tmp_path: Path) -> None:
    here = results(tmp_path / "here")
    assert compare(here, results(tmp_path / "same")) == (0.0, "equal, text by text")
    apart, sentence = compare(here, results(tmp_path / "near", arc_m="12.3451"))
    assert apart == pytest.approx(1e-4)
    assert "positions.csv by at most 0.0001" in sentence
    assert compare(here, results(tmp_path / "far", arc_m="12.4450"))[0] > MOST
    for k, change in enumerate(({"status": "doubtful"}, {"arc_m": ""})):
        assert compare(here, results(tmp_path / f"other{k}", **change))[0] == float("inf")


@pytest.mark.requirement("S2")
@pytest.mark.slow
@pytest.mark.parametrize("how", RESOLUTIONS)
def test_the_demonstration_is_the_same_with_other_versions(how: str) -> None:
    if shutil.which("uv") is None:
        pytest.skip("uv, which installs the lowest versions, is not installed")
    program = Path(__file__).with_name("dependency_versions.py")
    done = subprocess.run([sys.executable, str(program), how], capture_output=True, text=True, check=False)
    if "dns error" in done.stdout or "Failed to fetch" in done.stdout:
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stdout + done.stderr

"""Cases of a benchmark written to folders, with the hashes of their files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from railfix.core.files import file_sha256
from railfix.core.settings import validate
from railfix.core.settings_files import write_toml
from railfix.evaluate.cases import CASE_FILE, CaseFile


def write_case(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the ``case.toml`` of a folder from its content without hashes; errors as `read_case`."""
    case = validate(CaseFile, {**content, "sha256": {}}, source=str(folder / CASE_FILE))
    hashes = {str(name): file_sha256(folder / name) for name in case.every_file()}
    write_toml(folder / CASE_FILE, {**content, "sha256": hashes}, what="a case of a benchmark")

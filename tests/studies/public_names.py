"""Public names of the last release, ``tests/references/public-names.txt``: written by ``public_names.py`` at a release.

One line for each name of ``railfix`` and each command. A test holds that each is still there, or that docs/changes.md
names it.
"""

from __future__ import annotations

import sys
from typing import Final

import paths
import railfix
from document_commands import every_command

KEPT: Final = paths.ROOT / "tests" / "references" / "public-names.txt"


def public_names() -> list[str]:
    """Return the names that a program or a person uses."""
    return sorted({f"railfix.{name}" for name in railfix.__all__} | set(every_command()))


def main() -> int:
    """Write the names."""
    names = public_names()
    KEPT.write_text("\n".join(names) + "\n", encoding="utf-8")
    sys.stdout.write(f"{KEPT}: {len(names)} names\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

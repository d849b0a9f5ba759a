"""``railfix demo``: the main job on the log that comes with railfix, against its truth."""

from __future__ import annotations


def demo() -> None:
    """Run the main job on the log that comes with railfix."""

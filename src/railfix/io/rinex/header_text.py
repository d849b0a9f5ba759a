"""Header records of written RINEX files."""

from __future__ import annotations

import numpy as np

PROGRAM = "railfix"


def header_line(text: str, label: str) -> str:
    """Format one header record of 80 columns with its line end; ValueError for more than 60 characters or no ASCII."""
    if len(text) > 60 or not text.isascii():
        raise ValueError(f"{label}: {text!r} is not ASCII of at most 60 characters")
    return f"{text:<60}{label:<20}\n"


def program_line(created: np.datetime64 | None) -> str:
    """Format PGM / RUN BY / DATE; the date, in UTC, is blank without `created`."""
    date = ""
    if created is not None:
        date = (
            str(np.datetime_as_string(created, unit="s")).replace("-", "").replace(":", "").replace("T", " ") + " UTC"
        )
    return header_line(f"{PROGRAM:<20}{'':20}{date:<20}", "PGM / RUN BY / DATE")

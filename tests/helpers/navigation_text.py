"""Text of made navigation files, line by line, for what the writer of the package would never write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: A sound Keplerian record (GPS-like orbit), by the names of `railfix.gnss.navigation.KeplerRecords` where it has them.
KEPLER: dict[str, float] = {
    "af0_s": -1.234567890123e-04, "af1": 3.4e-12, "af2": 0.0,
    "iode": 45.0, "crs": -57.25, "delta_n": 4.6e-09, "m0": 1.2345,
    "cuc": -3.0e-06, "eccentricity": 0.0123, "cus": 8.0e-06, "sqrt_a": 5153.7,
    "toe_sow_s": 460800.0, "cic": 1.1e-07, "omega0": -2.5, "cis": -9.0e-08,
    "i0": 0.965, "crc": 230.0, "omega": 0.75, "omega_dot": -8.1e-09,
    "i_dot": -1.5e-10, "data_source": 1.0, "week": 2111.0, "flag": 0.0,
    "accuracy_m": 2.0, "health": 0.0, "group_delay_1_s": -1.1e-08, "group_delay_2_s": 45.0,
    "transmitted": 457200.0, "fit": 4.0,
}  # fmt: skip

#: A sound GLONASS record, kilometres.
GLONASS: dict[str, float] = {
    "clock_bias": 5.0e-05, "relative_frequency": 9.0e-13, "message_time": 459000.0,
    "x": 10_000.0, "x_velocity": 1.0, "x_acceleration": 1.8e-9, "health": 0.0,
    "y": 15_000.0, "y_velocity": -2.0, "y_acceleration": 0.0, "frequency_channel": -4.0,
    "z": 18_000.0, "z_velocity": 1.1, "z_acceleration": -9.3e-10, "age": 0.0,
}  # fmt: skip

#: 460800 s of GPS week 2111.
TIME = "2020 06 26 08 00 00"
BLANK = " " * 19


def number(value: Any, exponent: str = "D") -> str:
    """One field of 19 columns; text is taken as it is, None is blank."""
    if value is None:
        return BLANK
    if isinstance(value, str):
        return f"{value:>19}"
    return f"{value:19.12E}".replace("E", exponent)


def header(version: float = 3.04, kind: str = "N", lines: Sequence[str] = (), *, end: str = "END OF HEADER") -> str:
    first = f"{version:9.2f}{'':11}{kind:<20}{'M':<20}RINEX VERSION / TYPE"
    return "\n".join([first, *lines, f"{'':60}{end}", ""])


def label(text: str, name: str) -> str:
    """One header line."""
    return f"{text:<60}{name}"


def record(name: str, changes: dict[str, Any] | None = None, *, time: str = TIME, exponent: str = "D") -> str:
    """Record of versions 3 and 4 (without the '>' line); `changes` by field."""
    return _record(f"{name} {time}", 4, name, changes, exponent)


def record_2(number_text: str, changes: dict[str, Any] | None = None, *, time: str, system: str = "G") -> str:
    """Record of version 2: two columns for the satellite, two for the year, seconds with a decimal."""
    return _record(f"{number_text} {time}", 3, system, changes, "D")


def _record(first: str, indent: int, name: str, changes: dict[str, Any] | None, exponent: str) -> str:
    values: dict[str, Any] = {**(GLONASS if name[0] == "R" else KEPLER), **(changes or {})}
    extra = values.pop("extra", [])
    fields = [number(v, exponent) for v in values.values()] + [number(v, exponent) for v in extra]
    lines = [first + "".join(fields[:3])]
    lines += [" " * indent + "".join(fields[i : i + 4]) for i in range(3, len(fields), 4)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def write(folder: Path, text: str, name: str = "made.nav") -> Path:
    path = folder / name
    path.write_bytes(text.encode("ascii"))
    return path

"""A tiny writer of RINEX observation text, for tests of the reader (one epoch at a time, strings only)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

Value = float | str | None


def record(text: str, label: str) -> str:
    """A header line."""
    return f"{text:<60}{label:<20}"


def field(value: Value, tail: str = "  ") -> str:
    """F14.3, loss-of-lock digit, strength digit; None is blank, a string stands as it is."""
    if value is None:
        return " " * 14 + tail
    return (value if isinstance(value, str) else f"{value:14.3f}") + tail


def header_3(
    types: Mapping[str, Sequence[str]] | None = None,
    *,
    version: str = "3.04",
    system: str = "M",
    time_system: str = "GPS",
    extra: Sequence[str] = (),
) -> list[str]:
    """Header of RINEX 3 and 4."""
    types = {"G": ("C1C", "L1C", "D1C", "S1C")} if types is None else types
    lines = [record(f"{version:>9}{'':11}{'OBSERVATION DATA':<20}{system}", "RINEX VERSION / TYPE")]
    lines.append(record("TRAIN", "MARKER NAME"))
    for letter, names in types.items():
        for first in range(0, len(names), 13):
            start = f"{letter}  {len(names):3d}" if first == 0 else " " * 6
            some = "".join(f" {name:<3}" for name in names[first : first + 13])
            lines.append(record(start + some, "SYS / # / OBS TYPES"))
    lines += extra
    lines.append(record(f"  2021     5    17     2    33   13.0050000     {time_system}", "TIME OF FIRST OBS"))
    return [*lines, record("", "END OF HEADER")]


def epoch_3(
    clock: str, satellites: Mapping[str, Sequence[str]] | None = None, *, flag: int = 0, count: int | None = None
) -> list[str]:
    """An epoch of RINEX 3: `clock` is hours, minutes and seconds as written, "02 33 13.0050000"."""
    satellites = {} if satellites is None else satellites
    number = len(satellites) if count is None else count
    head = f"> 2021 05 17 {clock:<16}  {flag}{number:3d}"
    return [head, *(f"{name:<3}" + "".join(fields) for name, fields in satellites.items())]


def header_2(
    types: Sequence[str] = ("L1", "C1", "L2", "P2"),
    *,
    version: str = "2.11",
    system: str = "G",
    extra: Sequence[str] = (),
    time_system: str = "GPS",
) -> list[str]:
    """Header of RINEX 2."""
    lines = [record(f"{version:>9}{'':11}{'OBSERVATION DATA':<20}{system}", "RINEX VERSION / TYPE")]
    lines.append(record("     1     1", "WAVELENGTH FACT L1/2"))
    for first in range(0, len(types), 9):
        start = f"{len(types):6d}" if first == 0 else " " * 6
        some = "".join(f"    {name}" for name in types[first : first + 9])
        lines.append(record(start + some, "# / TYPES OF OBSERV"))
    lines += extra
    if time_system:
        lines.append(record(f"  2005     4     2     0     0    0.0000000     {time_system}", "TIME OF FIRST OBS"))
    return [*lines, record("", "END OF HEADER")]


def epoch_2(
    clock: str, satellites: Mapping[str, Sequence[str]] | None = None, *, flag: int = 0, date: str = "05  4  2"
) -> list[str]:
    """An epoch of RINEX 2: `clock` is hours, minutes and seconds as written, " 0  0  0.0000000"."""
    satellites = {} if satellites is None else satellites
    names = list(satellites)
    head = f" {date} {clock:<16}  {flag}{len(names):3d}"
    lines = [head + "".join(names[:12])]
    lines += [" " * 32 + "".join(names[first : first + 12]) for first in range(12, len(names), 12)]
    for fields in satellites.values():
        lines += ["".join(fields[first : first + 5]) for first in range(0, len(fields), 5)]
    return lines


def event_2(flag: int, records: Sequence[str] = ()) -> list[str]:
    """An event of RINEX 2 without a time."""
    return [f"{'':28}{flag}{len(records):3d}", *records]


def text_of(lines: Sequence[str], *, end: str = "\n", strip: bool = True) -> bytes:
    """Lines as bytes; blanks at their ends cut, as most programs write them."""
    return "".join((line.rstrip(" ") if strip else line) + end for line in lines).encode("latin-1")


def write(path: Path, lines: Sequence[str], *, end: str = "\n", strip: bool = True) -> Path:
    """A file of lines."""
    path.write_bytes(text_of(lines, end=end, strip=strip))
    return path

"""Writer of RINEX 3.04 and 4.02 observation files (tables A2, A3). Equal input gives equal bytes."""

from __future__ import annotations

import gzip
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Final, Literal, cast, get_args

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Indices, Integers, Masks
from railfix.core.errors import OutputError, check_type
from railfix.core.files import FilePath, hatanaka_program
from railfix.core.staged_files import stage_file
from railfix.gnss.joined_observations import signals_by_system
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.io.rinex.observations_lines import KINDS

RinexVersion = Literal["3.04", "4.02"]  #: RINEX versions that can be written.

Packing = Literal["plain", "gz", "crx", "crx.gz"]

_HATANAKA_NAME: Final = re.compile(r"\.(crx|\d\dd)$", re.IGNORECASE)
_CRX_HEADER_BYTES: Final = 162


def detect_packing(path: FilePath) -> Packing:
    """Return the packing that a file name implies, such as "crx.gz" for ``front.crx.gz`` and "crx" for ``log.26d``."""
    name = Path(path).name
    inner = name.removesuffix(".gz")
    packing = ("crx" if _HATANAKA_NAME.search(inner) else "", "gz" if inner != name else "")
    return cast("Packing", ".".join(part for part in packing if part) or "plain")


@contextmanager
def open_target(path: FilePath, *, packing: Packing | None = None) -> Iterator[IO[bytes]]:
    """Open a stream to a file, packed as requested or as the file name implies. No file remains after an error.

    Raise ValueError if the packing is unknown, and OutputError if the text cannot be compressed.
    """
    kind = detect_packing(path) if packing is None else packing
    if kind not in get_args(Packing):
        raise ValueError(f"packing {kind!r} is unknown; expected one of {', '.join(get_args(Packing))}")
    with stage_file(path) as temporary, temporary.open("xb") as raw, ExitStack() as held:
        sink = cast("IO[bytes]", raw)
        if kind.endswith("gz"):
            zipped = gzip.GzipFile(filename="", mode="wb", fileobj=raw, mtime=0, compresslevel=6)
            sink = cast("IO[bytes]", held.enter_context(zipped))
        if kind.startswith("crx"):
            sink = held.enter_context(_hatanaka(path, sink))
        yield sink


@contextmanager
def _hatanaka(path: FilePath, sink: IO[bytes]) -> Iterator[IO[bytes]]:
    """Open a stream; `rnx2crx` of the `hatanaka` package compresses its text into `sink`."""
    with (
        hatanaka_program("rnx2crx") as program,
        tempfile.TemporaryFile(prefix="railfix-") as packed,
        tempfile.TemporaryFile(prefix="railfix-") as log,
    ):
        process = subprocess.Popen([str(program), "-"], stdin=subprocess.PIPE, stdout=packed, stderr=log)
        stream = cast("IO[bytes]", process.stdin)
        try:
            yield stream
            stream.close()
        except BrokenPipeError:
            pass  # the program ended early; its exit code and messages are checked below
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        log.seek(0)
        messages = " ".join(log.read().decode("ascii", "replace").split())
        if code != 0 or messages:
            raise OutputError(f"{path}: rnx2crx cannot compress the text ({messages or f'exit code {code}'})")
        packed.seek(0)
        sink.write(_without_date(packed.read(_CRX_HEADER_BYTES)))
        shutil.copyfileobj(packed, sink, 1 << 20)


def _without_date(head: bytes) -> bytes:
    """Blank the compression date in the header of a CRX file, so that equal input gives equal bytes."""
    lines = head.split(b"\n")
    lines[1] = lines[1][:40] + b" " * 20 + lines[1][60:]
    return b"\n".join(lines)


PROGRAM = "railfix"


def header_line(text: str, label: str) -> str:
    """Format one header record. Raise ValueError unless `text` has at most 60 characters, all ASCII."""
    if len(text) > 60 or not text.isascii():
        raise ValueError(f"{label}: {text!r} is not ASCII text of at most 60 characters")
    return f"{text:<60}{label:<20}\n"


def program_line(created: np.datetime64 | None) -> str:
    """Format PGM / RUN BY / DATE. The date is `created` (UTC), or blank if `created` is None."""
    date = "" if created is None else f"{created.astype('datetime64[s]').item():%Y%m%d %H%M%S} UTC"
    return header_line(f"{PROGRAM:<20}{'':20}{date:<20}", "PGM / RUN BY / DATE")


_BLOCK_EPOCHS: Final = 1024  #: Number of epochs that are formatted at a time.
_EPOCH_WIDTH: Final = 36  #: Number of bytes of an epoch line, including the line end.
_FIELD_WIDTH: Final = 16  #: Number of bytes of an observation (F14.3, LLI, SSI).
_BLANK: Final = ord(" ")
#: Four ASCII digits of each number from 0 to 9999, shape (10000, 4).
_FOUR: Final = (np.arange(10_000)[:, None] // (1000, 100, 10, 1) % 10 + ord("0")).astype(np.uint8)


def write_observations(
    observations: Observations | Iterable[Observations],
    path: FilePath,
    *,
    packing: Packing | None = None,
    version: RinexVersion = "3.04",
    observables: Mapping[str, Sequence[str]] | None = None,
    header: ObservationHeader | None = None,
    comments: Sequence[str] = (),
    created: np.datetime64 | None = None,
) -> None:
    """Write a RINEX observation file; a failed write leaves no file.

    Parameters
    ----------
    observations : Observations, or iterable of them
        Observations of a log, or its pieces in order of time. An epoch without observations is written with 0
        satellites. NaN is written as blank, and `break_before` as epoch flag 1.
    path : path-like
    packing : {"plain", "gz", "crx", "crx.gz"}, optional
        By default, the packing follows from the file name: Hatanaka for ``.crx`` and ``.26d``, gzip for ``.gz``.
    version : {"3.04", "4.02"}
    observables : mapping of str to sequence of str, optional
        Observation types of each constellation (``{"G": ["C1C", "L1C"]}``). Default: C, L, D and S of every signal in
        the first piece.
    header : ObservationHeader, optional
        Header to write; default: the header of the first piece.
    comments : sequence of str
        Comment lines of at most 60 ASCII characters.
    created : datetime64, optional
        Date of creation in the header, UTC; blank by default.

    Raises
    ------
    ValueError
        The observations have no epoch, a time tag is NaT or finer than 100 ns, a value is too large for F14.3, or a
        channel has no observation type.
    OutputError
        The file cannot be written.
    """
    if not isinstance(observations, Iterable):
        check_type(observations, Observations, "observations")
    pieces = iter([observations] if isinstance(observations, Observations) else observations)
    first = next((piece for piece in pieces if len(piece)), None)
    if first is None:
        raise ValueError("there is no epoch to write")
    header = header or first.header
    columns = _columns(first, observables)
    with open_target(path, packing=packing) as target:
        target.write(_observation_header(first, header, columns, version, program_line(created), comments))
        for piece in chain([first], pieces):
            for block in _text_blocks(piece, columns):
                target.write(block)


def _columns(first: Observations, given: Mapping[str, Sequence[str]] | None) -> dict[str, tuple[str, ...]]:
    if given is not None:
        wrong = [o for names in given.values() for o in names if len(o) != 3 or o[0] not in KINDS]
        if wrong:
            raise ValueError(f"{wrong[0]!r} is not an observable; C, L, D or S and a signal were expected, as in 'C1C'")
        return {system: tuple(names) for system, names in given.items()}
    signals = signals_by_system(first.satellite, first.signal)
    return {system: tuple(kind + name for name in names for kind in KINDS) for system, names in signals.items()}


# ---------------------------------------------------------------- header


def _observation_header(
    first: Observations,
    header: ObservationHeader,
    columns: Mapping[str, Sequence[str]],
    version: RinexVersion,
    stamp: str,
    comments: Sequence[str],
) -> bytes:
    systems = list(columns)
    letter = systems[0] if len(systems) == 1 else "M"
    place = np.nan_to_num(header.approximate_ecef_m)
    *parts, second = _calendar_text(first.time[:1]).tobytes().decode().split()
    date = "".join(f"{int(part):6d}" for part in parts) + f"{second:>13}"
    lines = [
        header_line(f"{version:>9}{'':11}{'OBSERVATION DATA':<20}{letter:<20}", "RINEX VERSION / TYPE"),
        stamp,
        *(header_line(comment, "COMMENT") for comment in comments),
        header_line(header.marker, "MARKER NAME"),
        header_line("", "MARKER NUMBER"),
        header_line("", "OBSERVER / AGENCY"),
        header_line(f"{'':20}{header.receiver[:20]:<20}", "REC # / TYPE / VERS"),
        header_line(f"{'':20}{header.antenna[:20]:<20}", "ANT # / TYPE"),
        header_line("".join(f"{v:14.4f}" for v in place), "APPROX POSITION XYZ"),
        header_line("".join(f"{v:14.4f}" for v in header.antenna_delta_hen_m), "ANTENNA: DELTA H/E/N"),
    ]
    for system, names in columns.items():
        for start in range(0, len(names), 13):
            lead = f"{system}  {len(names):3d}" if start == 0 else " " * 6
            lines.append(header_line(lead + "".join(f" {o}" for o in names[start : start + 13]), "SYS / # / OBS TYPES"))
    lines.append(header_line("DBHZ", "SIGNAL STRENGTH UNIT"))
    if np.isfinite(header.interval_s):
        lines.append(header_line(f"{header.interval_s:10.3f}", "INTERVAL"))
    lines.append(header_line(f"{date}     GPS", "TIME OF FIRST OBS"))
    lines.append(header_line("", "SYS / PHASE SHIFT"))
    if "R" in columns or header.glonass_channel:
        lines += _glonass_slots(header.glonass_channel)
    if header.leap_seconds is not None:
        lines.append(header_line(f"{header.leap_seconds:6d}", "LEAP SECONDS"))
    lines.append(header_line("", "END OF HEADER"))
    return "".join(lines).encode("ascii")


def _glonass_slots(channels: Mapping[str, int]) -> list[str]:
    items = [f"{name:3} {number:2d} " for name, number in sorted(channels.items())]
    lines = []
    for start in range(0, max(len(items), 1), 8):
        lead = f"{len(items):3d} " if start == 0 else " " * 4
        lines.append(header_line((lead + "".join(items[start : start + 8])).rstrip(), "GLONASS SLOT / FRQ #"))
    return [*lines, header_line(" C1C    0.000 C1P    0.000 C2C    0.000 C2P    0.000", "GLONASS COD/PHS/BIS")]


# ---------------------------------------------------------------- epochs


@dataclass(frozen=True)
class _WrittenRows:
    """Satellites and columns of one constellation, and the channel of each satellite and column."""

    satellites: tuple[str, ...]
    columns: tuple[str, ...]
    channel: Indices  #: Index of the channel of each satellite and column; -1 where there is none, shape (S, K).


def _rows(piece: Observations, columns: Mapping[str, Sequence[str]]) -> list[_WrittenRows]:
    names, signals = piece.satellite.tolist(), piece.signal.tolist()
    place = {key: i for i, key in enumerate(zip(names, signals, strict=True))}
    for name, signal in place:
        if not any(column[1:] == signal for column in columns.get(name[0], ())):
            raise ValueError(f"channel {name} {signal} has no observation type; add one to `observables`")
    rows = []
    for system in sorted(columns):
        satellites = tuple(sorted({name for name in names if name[0] == system}))
        if satellites:
            channel = [[place.get((name, column[1:]), -1) for column in columns[system]] for name in satellites]
            rows.append(_WrittenRows(satellites, tuple(columns[system]), np.array(channel, dtype=np.intp)))
    return rows


def _text_blocks(piece: Observations, columns: Mapping[str, Sequence[str]]) -> Iterator[bytes]:
    rows = _rows(piece, columns)
    for start in range(0, len(piece), _BLOCK_EPOCHS):
        part = piece[start : start + _BLOCK_EPOCHS]
        texts, keeps = zip(*(_satellite_lines(part, row) for row in rows), strict=True) if rows else ((), ())
        count = sum((keep[:, :, 0].sum(axis=1) for keep in keeps), np.zeros(len(part), dtype=np.int64))
        head = _epoch_lines(part.time, part.break_before, count)
        flat = [head, *(t.reshape(len(part), -1) for t in texts)]
        kept = [np.ones(head.shape, dtype=bool), *(k.reshape(len(part), -1) for k in keeps)]
        yield np.concatenate(flat, axis=1)[np.concatenate(kept, axis=1)].tobytes()


def _satellite_lines(part: Observations, row: _WrittenRows) -> tuple[Bytes, Masks]:
    """Format one constellation's lines, shape (T, S, width); return them and a mask of the bytes to write."""
    epochs, satellites, width = len(part), len(row.satellites), 3 + _FIELD_WIDTH * len(row.columns) + 1
    text = np.full((epochs, satellites, width), _BLANK, dtype=np.uint8)
    text[:, :, :3] = np.array(row.satellites, dtype="S3").view(np.uint8).reshape(satellites, 3)
    end = np.zeros((epochs, satellites), dtype=np.int64)
    for k, column in enumerate(row.columns):
        channel = row.channel[:, k]
        at = 3 + _FIELD_WIDTH * k
        value = np.where(channel >= 0, getattr(part, KINDS[column[0]])[:, channel], np.nan)
        present = np.isfinite(value)
        text[:, :, at : at + 14] = _format_f14_3(value)
        end[present] = at + 14
        if column[0] == "L":
            lock = np.where(channel >= 0, part.loss_of_lock[:, channel], 0)
            flagged = present & (lock > 0)
            text[:, :, at + 14][flagged] = lock[flagged] % 10 + ord("0")
            end[flagged] = at + 15
    keep = np.arange(width) <= end[:, :, None]
    keep[end == 0] = False
    np.put_along_axis(text, end[:, :, None], ord("\n"), axis=2)
    return text, keep


def _format_f14_3(value: Floats) -> Bytes:
    """Format values as F14.3, rounded half to even, shape (..., 14); NaN is blank."""
    present = np.isfinite(value)
    thousandths = np.rint(np.abs(np.where(present, value, 0.0)) * 1e3).astype(np.int64)
    negative = present & (value < 0) & (thousandths > 0)
    # F14.3 has ten digits before the point, or nine after a sign.
    if (thousandths >= np.where(negative, 10**12, 10**13)).any():
        raise ValueError("a value has too many digits for the F14.3 of RINEX")
    high, low = np.divmod(thousandths, 10**8)
    middle, last = np.divmod(low, 10**4)
    digits = np.concatenate([_FOUR[high // 10**4], _FOUR[high % 10**4], _FOUR[middle], _FOUR[last]], axis=-1)
    text = np.empty((*value.shape, 14), dtype=np.uint8)
    text[..., :10], text[..., 10], text[..., 11:] = digits[..., 3:13], ord("."), digits[..., 13:]
    blanks = np.zeros(value.shape, dtype=np.int8)
    for power in range(4, 13):
        blanks += thousandths < 10**power
    text[..., :9][np.arange(9, dtype=np.int8) < blanks[..., None]] = _BLANK
    text[..., :9][negative[..., None] & (np.arange(9, dtype=np.int8) == blanks[..., None] - 1)] = ord("-")
    text[~present] = _BLANK
    return text


def _calendar_text(time: Datetimes) -> Bytes:
    """Format times as ``yyyy mm dd hh mm ss.sssssss``, shape (T, 27)."""
    if np.isnat(time).any() or (time.astype("datetime64[ns]").astype(np.int64) % 100).any():
        raise ValueError("a time tag is NaT or finer than 100 ns, which the F11.7 of RINEX cannot hold")
    iso = np.datetime_as_string(time, unit="ns").astype("S29")
    text = iso.view(np.uint8).reshape(len(time), 29)[:, :27].copy()
    text[:, [4, 7, 10, 13, 16]] = _BLANK
    text[text[:, 17] == ord("0"), 17] = _BLANK
    return text


def _epoch_lines(time: Datetimes, flag: Masks, count: Integers) -> Bytes:
    """Format ``> yyyy mm dd hh mm ss.sssssss  f nnn`` with line ends, shape (T, 36)."""
    text = np.full((len(time), _EPOCH_WIDTH), _BLANK, dtype=np.uint8)
    text[:, 0], text[:, -1] = ord(">"), ord("\n")
    text[:, 2:29] = _calendar_text(time)
    text[:, 31] = np.where(flag, ord("1"), ord("0"))
    text[:, 32:35] = _FOUR[count][:, 1:]
    text[count < 100, 32] = _BLANK
    text[count < 10, 33] = _BLANK
    return text

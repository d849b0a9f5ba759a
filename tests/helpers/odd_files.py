"""Files in odd forms, as receivers, spreadsheets and power cuts leave them, made from good ones by chance."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import re
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Final

import ncompress

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

#: A form of a text file: its lines with their ends, changed.
Form = Callable[[list[str], Random], list[str]]


@dataclass(frozen=True)
class OddFile:
    """A file in an odd form; `forms` are the names of what was done to it."""

    path: Path
    forms: tuple[str, ...]


def _zip(content: bytes, name: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return file.getvalue()


#: Forms of packed files: ending, and what packs the content of a file of a name.
PACKED: Final[dict[str, Callable[[bytes, str], bytes]]] = {
    ".gz": lambda content, _: gzip.compress(content),
    ".Z": lambda content, _: ncompress.compress(content),
    ".bz2": lambda content, _: bz2.compress(content),
    ".xz": lambda content, _: lzma.compress(content),
    ".zst": lambda content, _: zstd.compress(content),
    ".zip": _zip,
    ".gz.zip": lambda content, name: _zip(gzip.compress(content), f"{name}.gz"),
}
#: Forms of bytes, of any text file.
_BYTES: Final[dict[str, Callable[[bytes, Random], bytes]]] = {
    "line ends of Windows": lambda content, _: content.replace(b"\n", b"\r\n"),
    "byte order mark": lambda content, _: b"\xef\xbb\xbf" + content,
    "blank lines at the end": lambda content, _: content + b"\n\n",
    "no end of the last line": lambda content, _: content.rstrip(b"\n"),
    "cut": lambda content, rng: content[: len(content) - rng.randrange(1, len(content) // 4)],
    "zeros at the end": lambda content, rng: content + bytes(rng.randrange(1, 600)),
    "damaged character": lambda content, rng: _with_byte(content, rng, rng.randrange(32, 127)),
    "no text": lambda content, rng: _with_byte(content, rng, rng.randrange(128, 256)),
}


def _with_byte(content: bytes, rng: Random, byte: int) -> bytes:
    at = rng.randrange(len(content))
    return content[:at] + bytes([byte]) + content[at + 1 :]


def _epochs(lines: list[str]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the epochs of RINEX 3."""
    starts = [k for k, line in enumerate(lines) if line.startswith(">")]
    ends = [*starts[1:], len(lines)]
    return lines[: starts[0]], [lines[a:b] for a, b in zip(starts, ends, strict=True)]


def _join(header: list[str], epochs: list[list[str]]) -> list[str]:
    return [*header, *(line for epoch in epochs for line in epoch)]


def _doubled(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    k = rng.randrange(len(epochs))
    return _join(header, [*epochs[: k + 1], epochs[k], *epochs[k + 1 :]])


def _overlap(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    k = rng.randrange(4, len(epochs))
    return _join(header, [*epochs[:k], *epochs[max(k - 11, 0) :]])


def _exchanged(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    k = rng.randrange(len(epochs) - 1)
    epochs[k], epochs[k + 1] = epochs[k + 1], epochs[k]
    return _join(header, epochs)


def _second_header(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    k = rng.randrange(1, len(epochs))
    return [*_join(header, epochs[:k]), *_join(header, epochs[k:])]


def _other_second_header(lines: list[str], rng: Random) -> list[str]:
    """The second header and its epochs have the first two types of every constellation exchanged."""
    header, epochs = _epochs(lines)
    k = rng.randrange(1, len(epochs))
    types = re.compile(r"^([A-Z ] +\d+) (\w{3}) (\w{3})(.*SYS / # / OBS TYPES.*\n)")
    other = [types.sub(r"\1 \3 \2\4", line) for line in header]
    moved = [
        [line if line[0] == ">" else f"{line[:3]}{line[19:35]:16}{line[3:19]}{line[35:]}" for line in epoch]
        for epoch in epochs[k:]
    ]
    return [*_join(header, epochs[:k]), *_join(other, moved)]


def _comments(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    epochs.insert(rng.randrange(len(epochs)), [f"{'a remark':60}COMMENT\n"] * rng.randrange(1, 4))
    return _join(header, epochs)


def _event(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    epochs.insert(rng.randrange(1, len(epochs)), [f">{'':30}4  1\n", f"{'a remark':60}COMMENT\n"])
    return _join(header, epochs)


def _satellites_missing(lines: list[str], rng: Random) -> list[str]:
    header, epochs = _epochs(lines)
    epochs[rng.randrange(len(epochs))].pop()
    return _join(header, epochs)


def _column_off(lines: list[str], rng: Random) -> list[str]:
    labels = (
        "TIME OF FIRST OBS",
        "APPROX POSITION XYZ",
        "ANT # / TYPE",
        "MARKER NAME",
        "INTERVAL",
        "SYS / # / OBS TYPES",
    )
    chosen = [k for k, line in enumerate(lines) if line[60:].strip() in labels]
    if not chosen:
        return lines
    k = rng.choice(chosen)
    moved = f"{lines[k][1:60]} " if lines[k][0] == " " else f" {lines[k][:59]}"
    return [*lines[:k], moved + lines[k][60:], *lines[k + 1 :]]


def _no_end_of_header(lines: list[str], _: Random) -> list[str]:
    return [line for line in lines if "END OF HEADER" not in line]


def _header_only(lines: list[str], _: Random) -> list[str]:
    end = next((k for k, line in enumerate(lines) if "END OF HEADER" in line), 0)
    return lines[: end + 1]


def _line_left_out(lines: list[str], rng: Random) -> list[str]:
    k = rng.randrange(len(lines) // 2, len(lines))
    return [*lines[:k], *lines[k + 1 :]]


def _line_doubled(lines: list[str], rng: Random) -> list[str]:
    k = rng.randrange(len(lines) // 2, len(lines))
    return [*lines[:k], lines[k], *lines[k:]]


def _exponents(lines: list[str], _: Random) -> list[str]:
    return [re.sub(r"(\d)[DE]([+-]\d)", r"\1e\2", line) for line in lines]


def _letters_replaced(pairs: dict[str, str]) -> Form:
    """Return a form in which words are replaced everywhere."""

    def form(lines: list[str], _: Random) -> list[str]:
        text = "".join(lines)
        for old, new in pairs.items():
            text = text.replace(old, new)
        return text.splitlines(keepends=True)

    return form


def _rows_shuffled(lines: list[str], rng: Random) -> list[str]:
    rest = lines[1:]
    rng.shuffle(rest)
    return [lines[0], *rest]


def _cell_emptied(lines: list[str], rng: Random) -> list[str]:
    k = rng.randrange(1, len(lines))
    cells = lines[k].rstrip("\n").split(",")
    cells[rng.randrange(len(cells))] = ""
    return [*lines[:k], ",".join(cells) + "\n", *lines[k + 1 :]]


def _extra_column(lines: list[str], _: Random) -> list[str]:
    return [line.rstrip("\n") + (",remark\n" if k == 0 else ",x\n") for k, line in enumerate(lines)]


def _comment_lines(lines: list[str], rng: Random) -> list[str]:
    k = rng.randrange(1, len(lines))
    return [*lines[:k], "# a remark\n", *lines[k:]]


def _sentence_without_checksum(lines: list[str], rng: Random) -> list[str]:
    k = rng.randrange(len(lines))
    return [*lines[:k], lines[k].split("*")[0] + "\n", *lines[k + 1 :]]


def _fix_without_height(lines: list[str], rng: Random) -> list[str]:
    chosen = [k for k, line in enumerate(lines) if "GGA" in line]
    k = rng.choice(chosen)
    cells = lines[k].split("*")[0].split(",")
    cells[9] = cells[11] = ""
    return [*lines[:k], ",".join(cells) + "\n", *lines[k + 1 :]]


def _other_sentences(lines: list[str], rng: Random) -> list[str]:
    k = rng.randrange(len(lines))
    return [*lines[:k], "!AIVDM,1,1,,A,14eG;o@034o8sd<L9i:a;WF>062D,0*7D\n", "boot 3.1\n", *lines[k:]]


def _point_left_out(lines: list[str], rng: Random) -> list[str]:
    """Leave out one of the lines that hold a point."""
    rows = [k for k, line in enumerate(lines) if re.search(r"\d\.\d{5}", line)]
    k = rng.choice(rows[1:-1])
    return [*lines[:k], *lines[k + 1 :]]


def _point_doubled(lines: list[str], rng: Random) -> list[str]:
    rows = [k for k, line in enumerate(lines) if re.search(r"\d\.\d{5}", line)]
    k = rng.choice(rows[1:-1])
    return [*lines[:k], lines[k], *lines[k:]]


def _height_left_out(lines: list[str], rng: Random) -> list[str]:
    """Leave out the last number of one line that holds a point, or its element ``ele``."""
    rows = [k for k, line in enumerate(lines) if re.search(r"\d\.\d{5}", line)]
    k = rng.choice(rows)
    return [*lines[:k], re.sub(r"<ele>[^<]*</ele>|,\s*-?[\d.]+(?=[\]\s])", "", lines[k], count=1), *lines[k + 1 :]]


def _fields_of_pos(mark: str) -> Form:
    """Return a form in which the columns of RTKLIB's solution have another separator."""
    return lambda lines, _: [line if line[0] == "%" else mark.join(line.split()) + "\n" for line in lines]


_XML_FORMS: Final[dict[str, Form]] = {
    "XML comment": lambda lines, _: [lines[0], "<!-- a remark -->\n", *lines[1:]],
    "no XML declaration": lambda lines, _: lines[1:],
    "Latin-1": lambda lines, _: ['<?xml version="1.0" encoding="ISO-8859-1"?>\n<!-- \xfc -->\n', *lines[1:]],
    "point left out": _point_left_out, "point doubled": _point_doubled, "no height": _height_left_out,
}  # fmt: skip
#: Forms of text by kind of file.
FORMS: Final[dict[str, dict[str, Form]]] = {
    "observations": {
        "doubled epoch": _doubled, "overlap": _overlap, "exchanged epochs": _exchanged,
        "second header": _second_header, "second header with other types": _other_second_header,
        "comments in the data": _comments, "event": _event, "satellite missing": _satellites_missing,
        "field a column off": _column_off, "no end of the header": _no_end_of_header, "header only": _header_only,
        "line left out": _line_left_out, "line doubled": _line_doubled,
    },
    "navigation": {
        "exponents": _exponents, "line left out": _line_left_out, "line doubled": _line_doubled,
        "no end of the header": _no_end_of_header, "header only": _header_only,
    },
    "positions": {
        "semicolons": _letters_replaced({",": ";"}), "tabs": _letters_replaced({",": "\t"}),
        "semicolons and decimal commas": _letters_replaced({",": ";", ".": ","}),
        "usual names": _letters_replaced({"latitude_deg": "Latitude", "longitude_deg": "Longitude"}),
        "rows shuffled": _rows_shuffled, "cell emptied": _cell_emptied, "further column": _extra_column,
        "comments": _comment_lines, "line left out": _line_left_out, "line doubled": _line_doubled,
    },
    "nmea": {
        "no checksum": _sentence_without_checksum, "no height": _fix_without_height, "others": _other_sentences,
        "prefix": _letters_replaced({"$G": "NMEA,$G"}), "line left out": _line_left_out, "line doubled": _line_doubled,
    },
    "rtklib": {
        "commas": _fields_of_pos(","), "comments": _comment_lines, "line left out": _line_left_out,
        "line doubled": _line_doubled, "rows shuffled": _rows_shuffled,
    },
    "gpx": {
        **_XML_FORMS, "1.0": _letters_replaced({"GPX/1/1": "GPX/1/0", 'version="1.1"': 'version="1.0"'}),
        "prefix": _letters_replaced({"<trk": "<g:trk", "</trk": "</g:trk", "<gpx ": "<g:gpx ", "</gpx": "</g:gpx",
                                     "<time": "<g:time", "</time": "</g:time", "<ele": "<g:ele", "</ele": "</g:ele",
                                     "xmlns=": "xmlns:g="}),
        "no times": lambda lines, _: [re.sub("<time>.*?</time>", "", line) for line in lines],
    },
    "kml": {
        **_XML_FORMS, "clamped to the ground": _letters_replaced({">absolute<": ">clampToGround<"}),
        "above the ground": _letters_replaced({">absolute<": ">relativeToGround<"}),
        "no mode": _letters_replaced({"<altitudeMode>absolute</altitudeMode>": ""}),
        "blanks after commas": lambda lines, _: [re.sub(r"(?<=\d),(?=\d)", ", ", line) for line in lines],
        "no name": _letters_replaced({"<name>line</name>": ""}),
        "a station": _letters_replaced({"<Document>": "<Document><Placemark><Point><coordinates>8,47</coordinates>"
                                                      "</Point></Placemark>"}),
    },
    "geojson": {
        "point left out": _point_left_out, "point doubled": _point_doubled, "no height": _height_left_out,
        "in one line": lambda lines, _: ["".join(lines).replace("\n", "")],
        "no datum": _letters_replaced({'"height_datum": "ellipsoidal"': '"remark": 1'}),
        "a feature without geometry": _letters_replaced(
            {'"features": [': '"features": [{"type": "Feature", "properties": null, "geometry": null},'}
        ),
        "old CRS member": _letters_replaced({'"features": [': '"crs": {"type": "name", "properties": '
                                             '{"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}, "features": ['}),
    },
    "track": {
        "semicolons": _letters_replaced({",": ";"}), "tabs": _letters_replaced({",": "\t"}),
        "semicolons and decimal commas": _letters_replaced({",": ";", ".": ","}),
        "usual names": _letters_replaced({"latitude_deg": "Latitude", "longitude_deg": "Longitude"}),
        "height without a unit": _letters_replaced({"height_m": "Altitude"}),
        "height in feet": _letters_replaced({"height_m": "height_ft"}),
        "rows shuffled": _rows_shuffled, "cell emptied": _cell_emptied, "further column": _extra_column,
        "comments": _comment_lines, "line left out": _line_left_out, "line doubled": _line_doubled,
    },
}  # fmt: skip
#: Names that files of a kind have beside their usual one.
_NAMES: Final = {
    "observations": ("front.obs", "front.24o", "log.txt", "upload"),
    "navigation": ("brdc.nav", "brdc.24n", "eph.txt", "download"),
    "positions": ("run.csv", "run.txt", "run.dat"),
    "nmea": ("run.nmea", "run.txt", "run.log"),
    "rtklib": ("run.pos", "run.txt", "run"),
    "gpx": ("run.gpx", "run.xml", "run"),
    "kml": ("line.kml", "line.xml", "line"),
    "geojson": ("line.geojson", "line.json", "line.txt"),
    "track": ("line.csv", "line.txt", "line"),
}


def write_odd_file(kind: str, good: bytes, folder: Path, seed: int) -> OddFile:
    """Write a good file of a kind in one or two odd forms, packed one time in three."""
    rng = Random(f"{kind} {seed}")
    forms: list[str] = []
    content, name = good, rng.choice(_NAMES[kind])
    if rng.random() < 0.8:
        form = rng.choice([*FORMS[kind]])
        content = "".join(FORMS[kind][form](content.decode("latin-1").splitlines(keepends=True), rng)).encode("latin-1")
        forms.append(form)
    if rng.random() < 0.4:
        form = rng.choice([*_BYTES])
        content = _BYTES[form](content, rng)
        forms.append(form)
    if kind in ("positions", "track") and "byte order mark" not in forms and rng.random() < 0.15:
        content = content.decode("latin-1").encode("utf-16")
        forms.append("UTF-16")
    if rng.random() < 0.3:
        ending = rng.choice([*PACKED])
        content = PACKED[ending](content, name)
        name += ending
        forms.append(ending)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_bytes(content)
    return OddFile(path=path, forms=tuple(forms))

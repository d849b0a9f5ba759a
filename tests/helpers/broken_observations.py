"""Broken observation and navigation files."""

from __future__ import annotations

import gzip
import random
import re
import zipfile
from pathlib import Path
from typing import Any

from broken_bench import INPUT, MISMATCH, Bench, broken, epoch_starts

Options = dict[str, Any]


def without_line(path: Path, label: str) -> Path:
    """Drop the header lines with a label."""
    lines = path.read_text().splitlines(keepends=True)
    kept = [line for line in lines if line[60:].strip() != label]
    assert len(kept) < len(lines)
    path.write_text("".join(kept))
    return path


def of_the_next_week(text: str) -> str:
    """Navigation records of GPS, QZSS and Galileo a week later: their clock time, and the week of toe."""

    def move(match: re.Match[str]) -> str:
        return f"{match[1]} {match[2]} {int(match[3]) + 7:02d} "

    later = re.sub(r"(?m)^([GJEC]\d\d \d{4}) (\d\d) (\d\d) ", move, text)
    assert " 2.304000000000E+03" in later
    return later.replace(" 2.304000000000E+03", " 2.305000000000E+03")


# --- observation files -------------------------------------------------------------------------


@broken(INPUT, "folder")
def observations_are_a_folder(bench: Bench) -> Options:
    (bench.folder / "logs").mkdir()
    return {"front": bench.folder / "logs"}


@broken(INPUT, "random.obs")
def observations_binary(bench: Bench) -> Options:
    return {"front": bench.write("random.obs", random.Random(1).randbytes(5000))}


@broken(INPUT, "front.zip", "zip archive of 2 files")
def observations_of_two_in_a_zip_archive(bench: Bench) -> Options:
    with zipfile.ZipFile(bench.folder / "front.zip", "w") as archive:
        archive.write(bench.front, "a.obs")
        archive.write(bench.front, "b.obs")
    return {"front": bench.folder / "front.zip"}


@broken(INPUT, "front.obs.gz", "early")
def observations_gzip_truncated(bench: Bench) -> Options:
    packed = gzip.compress(bench.front.read_bytes(), mtime=0)
    return {"front": bench.write("front.obs.gz", packed[: len(packed) // 2])}


@broken(INPUT, "front.obs.gz")
def observations_gzip_damaged(bench: Bench) -> Options:
    packed = bytearray(gzip.compress(bench.front.read_bytes(), mtime=0))
    middle = len(packed) // 2
    packed[middle : middle + 64] = bytes(64)
    return {"front": bench.write("front.obs.gz", bytes(packed))}


@broken(INPUT, "front.crx")
def observations_hatanaka_truncated(bench: Bench) -> Options:
    import hatanaka

    packed = hatanaka.rnx2crx(bench.front.read_bytes())
    return {"front": bench.write("front.crx", packed[: len(packed) // 2])}


@broken(INPUT, "front.obs", "line 1")
def observations_of_an_unknown_version(bench: Bench) -> Options:
    text = bench.front.read_text()
    return {"front": bench.write("front.obs", "     7.00" + text[9:])}


@broken(INPUT, "front.obs")
def observations_without_version(bench: Bench) -> Options:
    return {"front": without_line(bench.front, "RINEX VERSION / TYPE")}


@broken(INPUT, "front.obs", "OBS TYPES")
def observations_without_types(bench: Bench) -> Options:
    return {"front": without_line(bench.front, "SYS / # / OBS TYPES")}


@broken(INPUT, "front.obs", "END OF HEADER")
def observations_without_end_of_header(bench: Bench) -> Options:
    return {"front": without_line(bench.front, "END OF HEADER")}


@broken(INPUT, "front.obs", "epoch")
def observations_without_epochs(bench: Bench) -> Options:
    text = bench.front.read_text()
    return {"front": bench.write("front.obs", text[: text.index("\n>") + 1])}


@broken(INPUT, "front.obs", "line")
def observations_with_a_broken_epoch_line(bench: Bench) -> Options:
    lines = bench.front.read_text().splitlines(keepends=True)
    at = epoch_starts("".join(lines))[5]
    lines[at] = lines[at].replace(" 0 ", " ? ", 1).replace("> 20", "> xx")
    return {"front": bench.write("front.obs", "".join(lines))}


@broken(INPUT, "front.obs", "line")
def observations_with_letters_for_a_number(bench: Bench) -> Options:
    lines = bench.front.read_text().splitlines(keepends=True)
    at = epoch_starts("".join(lines))[5] + 1
    lines[at] = lines[at][:5] + "2l345678.9O1" + lines[at][17:]
    return {"front": bench.write("front.obs", "".join(lines))}


@broken(INPUT, "front.obs", "line")
def observations_with_a_wrong_count_of_satellites(bench: Bench) -> Options:
    lines = bench.front.read_text().splitlines(keepends=True)
    at = epoch_starts("".join(lines))[5]
    lines[at] = f"{lines[at][:32]}{int(lines[at][32:35]) + 2:3d}{lines[at][35:]}"
    return {"front": bench.write("front.obs", "".join(lines))}


@broken(MISMATCH, "brdc.nav", "navigation file of that day")
def observations_of_another_week(bench: Bench) -> Options:
    text = re.sub(r"(?m)^> (\d{4})", lambda m: f"> {int(m[1]) - 20}", bench.front.read_text())
    return {"front": bench.write("front.obs", text)}


@broken(MISMATCH, "front", "rear", "overlap")
def observations_of_antennas_at_different_hours(bench: Bench) -> Options:
    text = re.sub(
        r"(?m)^(> \d{4} \d\d \d\d )(\d\d)", lambda m: f"{m[1]}{(int(m[2]) + 1) % 24:02d}", bench.rear.read_text()
    )
    return {"rear": bench.write("rear.obs", text)}


# --- navigation files --------------------------------------------------------------------------


@broken(INPUT, "random.nav")
def navigation_binary(bench: Bench) -> Options:
    return {"nav": bench.write("random.nav", random.Random(2).randbytes(5000))}


@broken(INPUT, "brdc.nav", "END OF HEADER")
def navigation_without_end_of_header(bench: Bench) -> Options:
    return {"nav": without_line(bench.nav, "END OF HEADER")}


@broken(INPUT, "brdc.nav")
def navigation_without_version(bench: Bench) -> Options:
    return {"nav": without_line(bench.nav, "RINEX VERSION / TYPE")}


@broken(INPUT, "brdc.nav", "record")
def navigation_without_records(bench: Bench) -> Options:
    text = bench.nav.read_text()
    return {"nav": bench.write("brdc.nav", text[: text.index("END OF HEADER") + 14])}


@broken(INPUT, "brdc.nav", "line")
def navigation_with_letters_for_a_number(bench: Bench) -> Options:
    lines = bench.nav.read_text().splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if re.match(r"[GE]\d\d \d{4} ", line)) + 2
    lines[at] = lines[at][:6] + "not a number" + lines[at][18:]
    return {"nav": bench.write("brdc.nav", "".join(lines))}


@broken(MISMATCH, "brdc.nav", "navigation file of that day")
def navigation_of_another_day(bench: Bench) -> Options:
    text = bench.nav.read_text()
    return {"nav": bench.write("brdc.nav", of_the_next_week(text))}


@broken(INPUT, "front.obs", "given twice")
def observations_given_twice_by_another_name(bench: Bench) -> Options:
    (bench.folder / "same.obs").symlink_to(bench.front)
    return {"front": [bench.front, bench.folder / "same.obs"]}

"""Source archive and wheel of the work tree, built twice and compared: ``reproducible_build.py --out dist``.

Both builds have the date of the commit (``SOURCE_DATE_EPOCH``) and differ in folder, times of the files, umask and time
zone; a third wheel is built from the source archive. Where all have one hash, archive, wheel and ``SHA256SUMS`` are put
into the folder. It needs git, a checkout and hatchling (extra ``test``), and no network.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Final

import paths
from railfix.core import file_sha256

#: Surroundings of the two builds: umask, time zone, time of all files.
SURROUNDINGS: Final = ((0o022, "UTC", 1_600_000_000), (0o077, "Asia/Tokyo", 1_700_000_000))


def copy_work_tree(folder: Path, *, time_s: int) -> None:
    """Write a checkout of the same commit with the files of the work tree, changes included."""
    subprocess.run(["git", "clone", "-q", "--shared", "--no-checkout", paths.ROOT, folder], check=True)
    subprocess.run(["git", "-C", folder, "reset", "-q", _git("rev-parse", "HEAD").strip()], check=True)
    for name in _git("ls-files", "-z", "--cached", "--others", "--exclude-standard").split("\0"):
        source, target = paths.ROOT / name, folder / name
        if name and source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
            os.utime(target, (time_s, time_s))


def build(
    folder: Path, out: Path, *, time_zone: str, umask: int, targets: tuple[str, ...] = ("sdist", "wheel")
) -> None:
    """Build archives of a source folder, without isolation and without a network."""
    words = [word for target in targets for word in ("-t", target)]
    surroundings = {"SOURCE_DATE_EPOCH": _git("log", "-1", "--format=%ct").strip(), "TZ": time_zone}
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out), *words]
    subprocess.run(command, cwd=folder, env=os.environ | surroundings, umask=umask, check=True, capture_output=True)


def built_twice(work: Path) -> dict[str, list[str]]:
    """Build twice, and a wheel from the first source archive.

    Returns
    -------
    dict of str to list of str
        SHA-256 of every build, by the name of the archive; the archives are in ``work/0``.
    """
    for k, (umask, time_zone, time_s) in enumerate(SURROUNDINGS):
        checkout = work / "/".join(["checkout"] * (k + 1)) / f"of_{k}"
        copy_work_tree(checkout, time_s=time_s)
        build(checkout, work / str(k), time_zone=time_zone, umask=umask)
    (archive,) = (work / "0").glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(work / "unpacked", filter="data")
    (unpacked,) = (work / "unpacked").iterdir()
    build(unpacked, work / "from_archive", time_zone="UTC", umask=0o022, targets=("wheel",))
    hashes: dict[str, list[str]] = {}
    for folder in ("0", "1", "from_archive"):
        for path in sorted((work / folder).iterdir()):
            hashes.setdefault(path.name, []).append(file_sha256(path))
    return hashes


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", paths.ROOT, *words], capture_output=True, text=True, check=True).stdout


def main() -> int:
    """Build, compare, and keep what is equal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=paths.ROOT / "dist")
    out: Path = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        hashes = built_twice(Path(folder))
        for name, found in hashes.items():
            sys.stdout.write(f"{found[0]}  {name}: {len(found)} builds, {len(set(found))} hash(es)\n")
        if any(len(set(found)) > 1 for found in hashes.values()):
            return 1
        out.mkdir(parents=True, exist_ok=True)
        for name in hashes:
            shutil.copy(Path(folder) / "0" / name, out)
        (out / "SHA256SUMS").write_text("".join(f"{found[0]}  {name}\n" for name, found in hashes.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())

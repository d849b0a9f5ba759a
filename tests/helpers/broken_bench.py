"""A small sound run whose inputs can be broken one by one."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

#: Epochs of the logs that are kept.
EPOCHS = 30

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the command line did."""

    code: int
    stdout: str
    stderr: str
    exception: BaseException | None


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Inputs of a sound run in a folder of their own, as plain text files.

    Attributes
    ----------
    folder : Path
    """

    folder: Path

    @property
    def front(self) -> Path:
        return self.folder / "front.obs"

    @property
    def rear(self) -> Path:
        return self.folder / "rear.obs"

    @property
    def nav(self) -> Path:
        return self.folder / "brdc.nav"

    @property
    def track(self) -> Path:
        return self.folder / "line.csv"

    @property
    def vehicle(self) -> Path:
        return self.folder / "train.toml"

    @property
    def out(self) -> Path:
        return self.folder / "results"

    def copy(self, folder: Path) -> Bench:
        """The same inputs in another folder."""
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        return Bench(folder=folder)

    def write(self, name: str, content: str | bytes) -> Path:
        """One more file beside the inputs."""
        path = self.folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def edit(self, path: Path, old: str, new: str, *, count: int = 1) -> Path:
        """Replace text in a file; the text must be there."""
        text = path.read_text()
        assert old in text, f"{old!r} is not in {path.name}"
        path.write_text(text.replace(old, new, count) if count else text.replace(old, new))
        return path

    def arguments(self, **changes: Any) -> list[str]:
        """Command line of the run; `changes` replace options, None drops one."""
        options: dict[str, Any] = {"front": self.front, "nav": self.nav, "track": self.track, "out": self.out}
        options |= changes
        words = ["run"]
        for name, value in options.items():
            for item in value if isinstance(value, list) else [value]:
                if item is True:
                    words.append(f"--{name}")
                elif item is not None:
                    words += [f"--{name.replace('_', '-')}", str(item)]
        return words

    def run(self, **changes: Any) -> Outcome:
        """Run the command line in this process."""
        from railfix.cli import app

        result = RUNNER.invoke(app, self.arguments(**changes))
        return Outcome(code=result.exit_code, stdout=result.stdout, stderr=result.stderr, exception=result.exception)


def shortened(text: str, epochs: int) -> str:
    """A RINEX 3 observation file cut after some epochs."""
    lines = text.splitlines(keepends=True)
    starts = [i for i, line in enumerate(lines) if line.startswith(">")]
    return "".join(lines[: starts[epochs]])


def epoch_starts(text: str) -> list[int]:
    """Line numbers (from 0) of the epoch lines of a RINEX 3 file."""
    return [i for i, line in enumerate(text.splitlines()) if line.startswith(">")]


def bench_in(folder: Path) -> Bench:
    """The shipped run, cut short and unpacked."""
    from railfix.core.files import read_bytes
    from railfix.simulate.demonstration import demo_files

    demo = demo_files()
    for name, what in (("front.obs", "front"), ("rear.obs", "rear"), ("brdc.nav", "nav")):
        text = read_bytes(demo[what]).decode("ascii")
        (folder / name).write_text(text if name.endswith(".nav") else shortened(text, EPOCHS))
    shutil.copy(demo["track"], folder / "line.csv")
    shutil.copy(demo["vehicle"], folder / "train.toml")
    return Bench(folder=folder)


#: Exit codes of the errors.
INPUT, SETTING, MISMATCH, NOTHING, OUTPUT = 3, 4, 5, 7, 8

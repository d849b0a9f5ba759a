"""The example of the README with what it really prints: ``python tests/studies/readme_example.py`` writes it there."""

from __future__ import annotations

import re
import shlex
import sys
import tempfile
from pathlib import Path
from typing import Final

from typer.testing import CliRunner

import paths

README: Final = paths.ROOT / "README.md"
BLOCK: Final = re.compile(r"(<!-- example -->\n```console\n)(.*?)(```\n)", re.DOTALL)


def shown() -> tuple[str, str]:
    """Command line, with its continuations, and output as the README shows them."""
    found = BLOCK.search(README.read_text(encoding="utf-8"))
    assert found, "README.md has no example"
    command, _, output = re.sub(r"\\\n", "\\\\\x00", found[2]).partition("\n")
    return command.removeprefix("$ ").replace("\x00", "\n"), output


def without_times(output: str) -> str:
    """Return an output without the time of the run, which no two runs share."""
    return re.sub(r"in [\d.]+ s \([\d,]+ epochs/s", "in ... s", output)


def real() -> str:
    """What the command prints now, run from the clone with results in a temporary folder."""
    from railfix.cli import app

    words = shlex.split(shown()[0].replace("\\\n", " "))[1:]
    place = words.index("--out") + 1
    named = words[place]
    with tempfile.TemporaryDirectory() as folder:
        words[place] = str(Path(folder) / named)
        words = [str(paths.ROOT / word) if word.startswith("data/") else word for word in words]
        result = CliRunner(env={"COLUMNS": "120", "TERM": "dumb"}).invoke(app, words)
        assert result.exit_code == 0, result.output
        output = result.stdout.replace(str(Path(folder)) + "/", "").replace(str(paths.ROOT) + "/", "")
        return output


def main() -> int:
    """Write the example."""
    text = README.read_text(encoding="utf-8")
    command, output = shown()[0], real()
    README.write_text(BLOCK.sub(lambda m: f"{m[1]}$ {command}\n{output}{m[3]}", text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

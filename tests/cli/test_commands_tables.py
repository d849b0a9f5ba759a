"""Tables on a terminal: no digit is cut at any width."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import sys
import termios
from pathlib import Path

import pytest

#: A table as wide as those of `railfix evaluate`, and one with a column an antenna.
_SCRIPT = """
from rich.table import Table
from railfix.cli.console import TableConsole, show_table
from railfix.core.tables import Table as Data
console = TableConsole()
head = ["run", "antenna", *(f"figure {k} m" for k in range(15))]
rows = [
    ["2024-03-05/results", "front", *(f"{1000 * row + 13.73 * k:.2f}" for k in range(15))] for row in range(3)
]
show_table(console, Data(name="wide", head=head, rows=rows, numeric=range(2, 17)))
table = Table("")
for name in ("front", "rear", "middle", "other"):
    table.add_column(name, justify="right")
table.add_row("indicative protection level of the filter, p50", *(f"{k}2,345.67 m" for k in range(4)))
console.print(table)
"""


def on_terminal(words: list[str], columns: int, folder: Path) -> str:
    """Output of a program on a terminal of so many columns, without its colours."""
    pid, terminal = pty.fork()
    if pid == 0:  # pragma: no cover (the other process)
        os.chdir(folder)
        os.environ |= {"TERM": "xterm", "NO_COLOR": "1"}
        os.environ.pop("COLUMNS", None)
        while os.get_terminal_size(1).columns != columns:
            pass
        os.execv(words[0], words)
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    parts = []
    try:
        while part := os.read(terminal, 65536):
            parts.append(part)
    except OSError:  # the end of a terminal on Linux
        pass
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    return re.sub(r"\x1b\[[0-9;]*m", "", b"".join(parts).decode()).replace("\r\n", "\n")


@pytest.mark.requirement("G4")
@pytest.mark.parametrize("columns", [80, 100, 120])
@pytest.mark.every(3)
def test_no_digit_is_cut_on_a_terminal(tmp_path: Path, columns: int) -> None:
    shown = on_terminal([sys.executable, "-c", _SCRIPT], columns, tmp_path)
    assert max(len(line) for line in shown.splitlines()) <= columns
    words = shown.split()
    for row in range(3):
        for k in range(15):
            assert f"{1000 * row + 13.73 * k:.2f}" in words
    for k in range(4):
        assert f"{k}2,345.67 m" in shown
    # each part has the name of its row
    assert words.count("2024-03-05/results") % 3 == 0
    assert words.count("2024-03-05/results") > 3

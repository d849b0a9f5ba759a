"""A PostgreSQL server of its own for tests and studies, from what Debian installs in /usr/lib/postgresql."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

import psutil


class Server:
    """PostgreSQL in a folder, as the user postgres where root runs the tests, who may not."""

    ADDRESS: Final = "postgresql+psycopg://postgres@127.0.1.1:54329/postgres"

    def __init__(self, folder: Path) -> None:
        self._data = folder / "postgres"
        self._programs = max(Path("/usr/lib/postgresql").glob("*/bin"))
        self._user = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
        self._data.mkdir()
        if self._user:
            folder.chmod(0o755)
            shutil.chown(self._data, "postgres")
        self._call("initdb", "--username", "postgres", "--auth", "trust")
        self.start()

    def _call(self, program: str, *options: str) -> None:
        command = [*self._user, self._programs / program, "-D", self._data, *options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def start(self) -> None:
        """Start it, until it can be connected to."""
        listen = f"-h 127.0.1.1 -p 54329 -k {self._data}"
        self._call("pg_ctl", "-w", "-l", f"{self._data}/log", "-o", listen, "start")

    def processes(self) -> list[psutil.Process]:
        """Return all its processes."""
        first = psutil.Process(int((self._data / "postmaster.pid").read_text().split()[0]))
        return [first, *first.children()]

    def kill(self) -> None:
        """End all its processes by SIGKILL."""
        ended = self.processes()
        for process in ended:
            process.kill()
        psutil.wait_procs(ended)

    def hang(self) -> None:
        """Stop all its processes (SIGSTOP): connections stay open, and nothing is answered."""
        for process in self.processes():
            process.suspend()

    def go_on(self) -> None:
        """Let its processes run again."""
        for process in self.processes():
            process.resume()

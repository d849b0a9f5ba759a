"""Ctrl-C, as a terminal sends it to all processes of a command: exit code 130, one sentence, nothing half-written."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bad_inputs import Desk
from railfix.simulate.demonstration import demo_inputs

pytestmark = pytest.mark.requirement("G5")

SENTENCE = "railfix: interrupted; unfinished files were removed, finished files are kept\n"
#: Longest time until a command is where it is interrupted, and until it has ended [s].
PATIENCE_S = 240.0


def interrupt(words: list[str], folder: Path, ready: Callable[[subprocess.Popen[str]], bool]) -> tuple[int, str]:
    """Start a command in a process group of its own, interrupt it where it is ready; return exit code and errors."""
    process = subprocess.Popen(
        [sys.executable, "-m", "railfix", *words], cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
        text=True, start_new_session=True,
    )  # fmt: skip
    latest = time.monotonic() + PATIENCE_S
    while not ready(process):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < latest
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    error = process.communicate(timeout=PATIENCE_S)[1]
    return process.returncode, error


def is_writing(folder: Path) -> Callable[[subprocess.Popen[str]], bool]:
    """Return whether results are being written into a hidden folder."""
    return lambda _: any(folder.rglob(".railfix-*"))


def is_starting(process: subprocess.Popen[str]) -> bool:
    """Return whether the program handles signals, SIGTERM among them; its commands are not imported yet."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return bool(int(status.split("SigCgt:")[1].split()[0], 16) >> (signal.SIGTERM - 1) & 1)


def has_begun(process: subprocess.Popen[str]) -> bool:
    """Return whether the command itself has been imported, with polars."""
    return "polars" in Path(f"/proc/{process.pid}/maps").read_text()


def demo_words() -> list[str]:
    inputs = demo_inputs()
    return ["--nav", str(inputs.nav[0]), "--track", str(inputs.track[0]), "--vehicle", str(inputs.vehicle)]


def test_a_run_that_is_interrupted_leaves_nothing(tmp_path: Path) -> None:
    words = ["run", "--front", str(demo_inputs().front[0]), *demo_words(), "--out", "out", "--chunk", "50"]
    code, error = interrupt(words, tmp_path, is_writing(tmp_path / "out"))
    assert (code, error) == (128 + signal.SIGINT, SENTENCE)
    assert [*tmp_path.rglob("*")] == []


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["doctor", "a"]])
def test_ctrl_c_while_the_program_starts_is_one_sentence(tmp_path: Path, words: list[str]) -> None:
    code, error = interrupt(words, tmp_path, is_starting)
    assert (code, error) == (128 + signal.SIGINT, SENTENCE)


def test_a_signal_that_the_caller_ignores_stays_ignored() -> None:
    """As `nohup` does with SIGHUP, and a shell with SIGINT of its background jobs."""
    process = subprocess.Popen(
        ["sh", "-c", f"trap '' HUP INT; exec {sys.executable} -m railfix simulate --list"], stdout=subprocess.DEVNULL
    )
    while not is_starting(process):
        time.sleep(0.01)
    for number in (signal.SIGHUP, signal.SIGINT):
        process.send_signal(number)
    assert process.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_an_evaluation_that_is_interrupted_leaves_nothing(good: Desk, tmp_path: Path) -> None:
    words = [str(word) for word in ("evaluate", good.folder / "results", "--reference", good.folder / "truth.csv")]
    code, error = interrupt([*words, "--out", "out"], tmp_path, has_begun)
    assert (code, error) == (128 + signal.SIGINT, SENTENCE)
    assert [*tmp_path.rglob("*")] == []


@pytest.mark.slow
def test_the_workers_of_a_campaign_end_with_it(tmp_path: Path) -> None:
    """polars takes the place of the default handler of Ctrl-C, with which workers went on to their last run."""
    inputs = demo_inputs()
    for name in "ABC":
        (tmp_path / "logs" / name).mkdir(parents=True)
        shutil.copy(inputs.front[0], tmp_path / "logs" / name / "front.crx.gz")
    (tmp_path / "line.toml").write_text(
        f'front = "logs/{{train}}/front.crx.gz"\nnav = "{inputs.nav[0]}"\ntrack = ["{inputs.track[0]}"]\n'
        f'vehicle = "{inputs.vehicle}"\n'
    )
    out = tmp_path / "out"
    code, error = interrupt(["campaign", "line.toml", "--out", "out"], tmp_path, is_writing(out))
    assert (code, error.splitlines()[-1:]) == (128 + signal.SIGINT, SENTENCE.splitlines())
    assert "Traceback" not in error
    left = [path.name for path in out.rglob("*")]
    assert not any(name.startswith(".railfix-") for name in left)
    assert "run.json" not in left

"""Scripts of ``shared/data/cases/ground`` on this code: ``python tests/studies/ground_cases.py [WORD]``.

Each is copied with this checkout in the place of its placeholders, and with the modules that have moved since; what it
prints is compared with the right value. Printed: a line a script, and the output of those that are wrong.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

CHECKOUT: Final = Path(__file__).resolve().parents[2]
CASES: Final = CHECKOUT.parent / "shared" / "data" / "cases" / "ground"
RAILFIX: Final = f"{sys.executable} -m railfix"
#: What the scripts import or name, and where it is now.
MOVED: Final = {
    "from railfix.ground.train import OnBoard, Authority": "from railfix.ground.authority import Authority\n"
    "from railfix.ground.on_board import OnBoard\nfrom railfix.ground.state import *",
    "'RAILFIX'": f"'{sys.executable}','-m','railfix'",
    "CHECKOUT": str(CHECKOUT),
}
DEMO: Final = CHECKOUT / "data" / "demo"
LIVE: Final = (
    f"{RAILFIX} live --front front.ubx --rear rear.ubx --track {DEMO}/track.csv --vehicle {DEMO}/vehicle.toml"
    f" --nav {DEMO}/nav.rnx.gz --send json@messages.json"
)
#: Start and end of a centre.
BEGIN: Final = (
    f"{RAILFIX} ground centre {{}} --page 127.0.0.1:0 --password password > centre.txt & centre=$! ; sleep 20"
)
END: Final = "kill $centre ; wait $centre"
#: Commands of each script, of the shell and one after the other, and what their output has in this order.
SCRIPTS: Final[dict[str, tuple[list[str], str]]] = {
    "antenna_jump": (
        ["python make.py", LIVE, "python antenna_jump.py messages.json"],
        "messages with bounds 574 true front end outside of its own bounds 0 .* jumps over 10 m 0",
    ),
    "live_batch_jamming": (
        ["python live_batch_jamming.py"],
        ".*".join(f"missing {share}%: .* batch (\\d+), live \\{k}" for k, share in enumerate((0, 2, 5, 10, 20), 1)),
    ),
    # the train is released where its interval covers its place, and no authority reaches it
    "release_outside": (
        ["python release_outside.py"],
        "recorded position .* stop None .* stop None .* c[.] .* 2795[.][.]3405 .* released by hand: None"
        ".* route of 2 -> train 1 comes from the opposite direction .* held",
    ),
    "restore_points": (["python restore_points.py"], "lost their detection .* commands to points: \\[\\]"),
    "dbfail": (
        ["python dbfail.py"],
        "failing: messages sent to trains: 28 .* messages sent 38 .* commands \\[\\] .* commands again \\[\\]"
        ".* no report since the start",
    ),
    # the train is freed by the order `correct-train`: test_an_order_frees_a_line_that_a_wrong_report_has_stopped
    "quick": (
        ["python quick.py"],
        "brake_reason 40.0 m/s exceeds .* brake_reason 60.0 m/s exceeds .* False 20.0 "
        "the report states standstill and a speed of 20.0 .* None Rejection.FAR_AHEAD Rejection.FAR_AHEAD None",
    ),
    "clockback": (
        [
            f"{RAILFIX} ground keys w/run/keys --train 1 --train 2 --train 3", "cp line.toml w/run/",
            BEGIN.format("w/run/line.toml"),
            *(f"python clockback.py {shift} 12" for shift in (0, -3600, 3600)),
            END, "python log.py w/run/*.db",
        ],
        "clock 0.0 reports, authorities \\(\\d+, [1-9]\\d*\\) .* -3600.0 .* \\(\\d+, [1-9]\\d*\\) .*"
        " 3600.0 .* \\(\\d+, [1-9]\\d*\\) .*on-board unit restarted.*on-board unit restarted",
    ),
    "negative_chunk": (["python negative_chunk.py"], "CPU in 5 s: 0[.].* SIGTERM -> rc 143 messages [1-9]"),
    "p5": (
        [
            f"{RAILFIX} ground keys keys --train 1", BEGIN.format("p5_centre.toml"),
            f"(sleep 20; python p5_feed.py) | {RAILFIX} ground train 1 --keys keys --centre 127.0.1.1:44381"
            " --centre 127.0.2.1:44382 | tail -1",
            END, "cat centre.txt",
        ],
        '"stopped": false.* reports used . 4\\d .*reports rejected . none',
    ),
}  # fmt: skip
LOG: Final = (
    "import sqlite3,sys\nfor row in sqlite3.connect(sys.argv[1]).execute('select text from log'): print(*row)\n"
)


def run_script(commands: list[str]) -> str:
    """Return what the commands of a script print, in one line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "w" / "run").mkdir(parents=True)
        for file in CASES.iterdir():
            text = file.read_text()
            for old, new in {**MOVED, "OWN": name}.items():
                text = text.replace(old, new)
            (folder / file.name).write_text(text)
        (folder / "log.py").write_text(LOG)
        (folder / "password").write_text("secret\n")
        (folder / "password").chmod(0o600)
        words = "\n".join(re.sub(r"\bpython (?=\w+\.py)", f"{sys.executable} ", command) for command in commands)
        done = subprocess.run(
            ["bash", "-c", words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
    return " ".join(done.stdout.split())


def main() -> None:
    wanted, wrong = " ".join(sys.argv[1:]), 0
    for script, (commands, expected) in SCRIPTS.items():
        if wanted in script:
            begin, text = time.monotonic(), run_script(commands)
            right = re.search(expected, text) is not None
            wrong += not right
            print(f"{'right' if right else 'WRONG'}  {script:20} {time.monotonic() - begin:5.0f} s", flush=True)
            if not right:
                print(f"       expected {expected}\n       printed {text}")
    print(f"{wrong} wrong")


if __name__ == "__main__":
    main()

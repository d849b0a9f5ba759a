"""``python -m railfix.simulate OUT``: write a simulated run.

Exit codes: 0 done, 2 the command line was misused, 4 a setting is out of range, 8 the output cannot
be written.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from railfix.errors import RailfixError
from railfix.simulate.line_settings import LineSettings
from railfix.simulate.run import write_run
from railfix.simulate.scenario import ReceiverSettings, RunSettings, Scenario, SkySettings

_EPILOG = """\
exit codes: 0 done; 2 the command line was misused; 4 a setting is out of range; 8 the output cannot be written.

the run that railfix ships:
  python -m railfix.simulate data/demo
an hour at 10 Hz, 18 satellites, 8 observables a satellite, two antennas (2 x 87 MB):
  python -m railfix.simulate OUT --seconds 3600 --line-km 20 --systems GJEC --satellites 18 --signals 2 --plain
"""


def _parser() -> argparse.ArgumentParser:
    default = Scenario()
    parser = argparse.ArgumentParser(
        prog="python -m railfix.simulate",
        description="Write a simulated run: RINEX logs of two antennas, navigation, track, vehicle, and the truth.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("out", metavar="OUT", help="folder; files of the same names in it are replaced")
    add("--seconds", type=float, default=default.duration_s, help="duration (default %(default)g)")
    add("--rate", type=float, default=default.rate_hz, help="epochs a second (default %(default)g)")
    add("--line-km", type=float, default=default.line.length_m / 1e3, help="length of the line (default %(default)g)")
    add("--speed-kmh", type=float, default=default.run.cruise_mps * 3.6, help="cruising speed (default %(default)g)")
    add("--systems", default=default.sky.systems, help="constellations out of GJEC (default %(default)s)")
    add("--satellites", type=int, default=None, help="at most so many, the highest (default all above 5 degrees)")
    add("--signals", type=int, choices=(1, 2), default=1, help="signals a satellite (default 1)")
    add("--clocks", choices=("separate", "common"), default="separate", help="receiver clocks (default separate)")
    add("--clock-steps", choices=("none", "millisecond"), default="none", help="clock steps (default none)")
    add("--seed", type=int, default=default.seed, help="of the noise and the sky (default %(default)d)")
    add("--plain", action="store_const", const="plain", default="packed", dest="packing", help="nothing packed")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(given)
    try:
        scenario = Scenario(
            seed=options.seed,
            duration_s=options.seconds,
            rate_hz=options.rate,
            line=LineSettings(length_m=options.line_km * 1e3),
            run=RunSettings(cruise_mps=options.speed_kmh / 3.6),
            sky=SkySettings(systems=options.systems, satellites_at_most=options.satellites),
            receiver=ReceiverSettings(
                signals_per_satellite=options.signals, clocks=options.clocks, clock_steps=options.clock_steps
            ),
        )
        command = " ".join(["python -m railfix.simulate", *given])
        files = write_run(scenario, options.out, packing=options.packing, command=command)
    except RailfixError as error:
        print(f"railfix.simulate: error: {error}", file=sys.stderr)
        return error.exit_code
    for name, path in files.items():
        print(f"{name:8} {path} ({path.stat().st_size / 1e6:.2f} MB)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

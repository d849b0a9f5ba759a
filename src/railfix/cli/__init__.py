"""The command line: the program ``railfix`` and its commands.

The commands import what they need when they run, so that ``railfix --help`` answers at once.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from railfix import __version__
from railfix.cli.ablate import ablate as ablate_command
from railfix.cli.cn0_curve import cn0_curve as cn0_curve_command
from railfix.cli.demo import demo as demo_command
from railfix.cli.error_model import error_model as error_model_command
from railfix.cli.evaluate import evaluate as evaluate_command
from railfix.cli.map import map_app
from railfix.cli.plot_screens import plot_screens as plot_screens_command
from railfix.cli.reference import reference as reference_command
from railfix.cli.report import report as report_command
from railfix.cli.run import run as run_command
from railfix.cli.simulate import simulate as simulate_command
from railfix.core.errors import RailfixError


class Commands(TyperGroup):
    """A group whose commands end with one sentence and the exit code of the error's class."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command; an error that the user can mend is told in one sentence."""
        try:
            return super().invoke(ctx)
        except RailfixError as error:
            sentence = " ".join(str(error).split())
            typer.echo(f"railfix: error: {sentence}", err=True)
            raise typer.Exit(error.exit_code) from None


app = typer.Typer(
    name="railfix",
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(*, asked: bool) -> None:
    if asked:
        typer.echo(f"railfix {__version__}")
        raise typer.Exit


@app.callback()
def railfix(
    *,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=lambda asked: _print_version(asked=asked),
            is_eager=True,
            help="Print the version and end.",
        ),
    ] = False,
) -> None:
    """Positions of a train along its line, from satellite receiver logs and a 3-D track map.

    A train runs on a known line, so its antenna lies on a known curve in space and its place is one
    number along it. railfix reads RINEX logs, navigation files and a track map, and writes that
    number for every epoch, with its standard deviation and the reason for everything it refused.

    To begin: `railfix demo`, then `railfix run --help`.

    Exit codes:

    - 0: done
    - 1: a defect of railfix itself (a traceback is shown)
    - 2: the command line was misused (unknown option, missing argument)
    - 3: an input file is missing, unreadable, or not what it should be
    - 4: a setting is misspelt, out of range, or contradicts another
    - 5: the inputs are readable but do not belong together (other day, other place)
    - 6: the track map was checked and has errors
    - 7: the run ended without a single position
    - 8: the output cannot be written

    An error is one sentence on the standard error output; it leaves no results behind.
    """


app.command("run")(run_command)
app.command("demo")(demo_command)
app.command("ablate")(ablate_command)
app.command("evaluate")(evaluate_command)
app.command("reference")(reference_command)
app.command("cn0-curve")(cn0_curve_command)
app.command("error-model")(error_model_command)
app.command("plot-screens")(plot_screens_command)
app.command("simulate")(simulate_command)
app.command("report")(report_command)
app.add_typer(map_app)


def main() -> None:
    """Entry point of the program ``railfix``."""
    app()

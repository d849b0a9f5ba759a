"""``railfix simulate``: simulated runs as files, with ground truth; ``railfix demo``: the demonstration positioned."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from railfix.cli.console import (
    TableConsole,
    describe_errors,
    prepare_kernels,
    progress_bar,
    show_budget,
    show_notes,
    show_table,
)
from railfix.cli.options import OverwriteOption, VerboseOption, check_set_once, from_models, overwriting, set_value
from railfix.core.errors import SettingsError
from railfix.core.settings import Settings, option
from railfix.core.tables import plural
from railfix.evaluate import Evaluation
from railfix.evaluate.tables import error_tables
from railfix.pipeline.config import Config
from railfix.pipeline.level_stage import prior_basis_text
from railfix.report import read_runs, write_page
from railfix.run import RunOptions, run_files
from railfix.run.output import Overwrite, check_folder
from railfix.simulate.demonstration import demo_inputs, demo_truth
from railfix.simulate.scenario import Scenario
from railfix.simulate.scenario_file import Recipe, list_scenarios, load_recipe


class SimulateOptions(Settings):
    """Folder of the runs, and settings that override the scenario."""

    out: Path | None = option(
        "Folder for the files; each run of a recipe in its own below it.", None, metavar="DIR", panel="Options"
    )
    seconds: float | None = option("Duration, overriding the scenario's.", None, metavar="S", gt=0.0)
    seed: int | None = option("Seed, overriding the scenario's.", None)
    setting: tuple[str, ...] = option(
        "One setting, overriding the scenario's: --set receiver.code_sigma_m=0; may be repeated.",
        (),
        name="--set",
        metavar="KEY=VALUE",
    )
    only: tuple[str, ...] = option(
        "Only this run of a recipe, by its number from 1 or its name; may be repeated.", (), metavar="RUN"
    )
    packing: Literal["packed", "plain"] = option("Write unpacked files: .rnx, .csv.", "packed", name="--plain")
    overwrite: Overwrite = option("Replace results that are already there.", "refuse", name="--overwrite")

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that override the scenario's."""
        check_set_once(self.setting)
        changes: dict[str, Any] = {}
        for text in self.setting:
            set_value(changes, text)
        given = {"duration_s": self.seconds, "seed": self.seed}
        return changes | {name: value for name, value in given.items() if value is not None}

    @property
    def words(self) -> list[str]:
        """Options that make the same run again."""
        sets = [("--set", text) for text in self.setting]
        given = [("--out", self.out), ("--seconds", self.seconds), ("--seed", self.seed), *sets]
        words = [word for name, value in given if value is not None for word in (name, str(value))]
        return [*words, "--plain"] if self.packing == "plain" else words


@from_models
def simulate(
    options: SimulateOptions,
    *,
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="SCENARIO", help="Scenario file (TOML), or the name of a shipped one, see --list."),
    ] = None,
    list_shipped: Annotated[bool, typer.Option("--list", help="Name the shipped scenarios and end.")] = False,
) -> None:
    """Simulate runs of a train: logs of two antennas, navigation, track map, vehicle, sensors, and ground truth.

    SCENARIO defines the line (elements, a generated one, or a track file), the motion of the train, the
    satellites (a simulated constellation, or a navigation file), receivers, errors, obstacles along the line and
    sensors on board. A recipe lists many runs, each written to its own folder. The same scenario gives the same
    files.

    Example: `railfix simulate demo --out simulated`

    Exit codes are those of `railfix --help`; 5 where the navigation file does not cover the scenario's time.
    """
    if list_shipped:
        for name in list_scenarios():
            recipe = load_recipe(name)
            runs = f" ({len(recipe.names)} runs)" if recipe.names[0] else ""
            typer.echo(f"{name:18} {recipe.description}{runs}")
        return
    if scenario is None or options.out is None:
        raise typer.BadParameter("give a SCENARIO and --out DIR, or --list")
    recipe = load_recipe(scenario)
    numbers = _choose_runs(recipe, options.only)
    folders = {number: options.out / recipe.names[number] for number in numbers}
    for folder in folders.values():
        check_folder(folder, overwrite=options.overwrite)
    scenarios = {number: recipe.scenario(number, changes=options.changes) for number in numbers}
    _simulate(recipe, ["railfix", "simulate", scenario, *options.words], scenarios, folders, options)


def _simulate(
    recipe: Recipe,
    command: list[str],
    scenarios: dict[int, Scenario],
    folders: dict[int, Path],
    options: SimulateOptions,
) -> None:
    from railfix.simulate.run import write_run  # scipy.signal takes 0.4 s to load

    done = 0
    files: dict[str, Path] = {}
    with progress_bar("simulation") as show:
        for at, (number, scenario) in enumerate(scenarios.items()):
            run = ["--only", recipe.names[number]] if recipe.names[number] else []
            total, before = 2 * scenario.epochs, done

            def progress(_antenna: str, epochs: int, at: int = at, total: int = total, before: int = before) -> None:
                nonlocal done
                done += epochs
                show(epochs=done, fraction=(at + (done - before) / total) / len(scenarios))

            files = write_run(
                scenario,
                folders[number],
                packing=options.packing,
                command=shlex.join([*command, *run]),
                overwrite=options.overwrite,
                progress=progress,
            )
    if len(scenarios) == 1:
        for path in files.values():
            typer.echo(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB)")
    else:
        for folder in folders.values():
            typer.echo(f"wrote {folder}")
    typer.echo(f"{done:,} antenna-epochs")


def _choose_runs(recipe: Recipe, only: tuple[str, ...]) -> list[int]:
    """Return the numbers of the runs to make, from 0."""
    if not only:
        return list(range(len(recipe.names)))
    if not recipe.names[0]:
        raise SettingsError(f"--only {only[0]}: {recipe.path} is a single run; leave the option out")
    numbers = []
    for word in only:
        if word in recipe.names:
            numbers.append(recipe.names.index(word))
        elif word.isdigit() and 1 <= int(word) <= len(recipe.names):
            numbers.append(int(word) - 1)
        else:
            raise SettingsError(
                f"--only {word}: {recipe.path} has no such run; it has {len(recipe.names)}, "
                f"{recipe.names[0]} to {recipe.names[-1]}"
            )
    return sorted(set(numbers))


def demo(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results; made where absent.")
    ] = Path("railfix-demo"),
    overwrite: OverwriteOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Position the log that comes with railfix, and compare it with its ground truth.

    The log is simulated: a train with two antennas on a line with curves and cant; the README beside the
    log describes it. railfix positions it as `railfix run` does. The report compares the positions on the
    map, and the conventional ones (3-D single point of unscreened ranges, moved to the nearest point of the
    line), with the ground truth, as `railfix report` does.

    Into DIR come `positions.csv`, `positions.parquet`, `train.csv`, `train.parquet`, `observations.parquet`,
    `run.json`, the folder `unscreened` of the run for the conventional positions, and `report.html`, the page
    to open in a browser.

    Example: `railfix demo --out first-look`

    Exit codes as `railfix --help` says.
    """
    inputs = demo_inputs()
    prepare_kernels()
    with progress_bar() as progress:
        options = RunOptions(observations="write", overwrite=overwriting(overwrite), chunk_epochs=200)
        summary = run_files(inputs, Config(), out=out, options=options, progress=progress)
    # the conventional positions of P1 use ranges that are not screened
    unscreened = Config(filter="off", screens=("elevation",), protection="off")
    run_files(inputs, unscreened, out=out / "unscreened", options=options.replaced(observations="skip"))
    runs, evaluation = read_runs([out], [demo_truth()], conventional=[out / "unscreened"])
    page = write_page(runs, evaluation, out / "report.html", title="railfix demonstration: a simulated run")
    console = TableConsole()
    for line in summary.verdict.lines():
        console.print(line)
    if evaluation is not None:
        console.print(describe_errors(evaluation))
    console.print(
        f"{plural(summary.notes, 'note')} on what this run does not promise: {out / 'run.json'}; --verbose shows all"
    )
    console.print(f"the log, its track map, vehicle and ground truth: {inputs.front[0].parent}")
    console.print(f"the report, to open in a browser: {page}")
    if verbose:
        console.print()
        show_notes(console, summary.notes)
        show_budget(console, summary)
        if evaluation is not None:
            show_errors(evaluation)


def show_errors(evaluation: Evaluation) -> None:
    """Print errors along the line: on the map, of those that passed every check, and of the conventional position."""
    console = TableConsole()
    for table in error_tables(evaluation):
        show_table(console, table)
    show_levels(evaluation, console)


def show_levels(evaluation: Evaluation, console: Console) -> None:
    """Print the protection level of each antenna: median, availability, and errors above it."""
    indicative = any(run.protection.get("basis") == "indicative" for run in evaluation.runs)
    for kind, found in evaluation.integrity.items():
        rows = found.stanford.filter(grouping="all", levels_of="usable", own_limit=True)
        for row in rows.filter(rows["antenna"] != "all").iter_rows(named=True):
            median = median_level(evaluation, kind, row["antenna"])
            over = found.beyond.filter(antenna=row["antenna"])
            named = "indicative protection level" if indicative else "protection level"
            console.print(
                f"{named} ({kind}), {row['antenna']}: median {'-' if median is None else f'{median:.2f} m'}, "
                f"within the alarm limit of {row['alarm_limit_m']:g} m at "
                f"{100 * (row['availability_of_observed'] or 0.0):.2f} % of the epochs with observations, errors over "
                f"it: {int(over['usable'].sum())} of {row['judged']:,}, and "
                f"{int((~over['usable']).sum())} where the run had raised an alarm or a doubt"
            )
    for text in dict.fromkeys(prior_basis_text(run.protection) for run in evaluation.runs if run.protection):
        console.print(f"protection level: {text}")


def median_level(evaluation: Evaluation, kind: str, antenna: str) -> float | None:
    """Return the median of the finite levels of the positions of status ok [m]; None where no level is finite."""
    if evaluation.levels is None:
        return None
    wanted = {"antenna": antenna, "position": "constrained_ok", "level": f"{kind}_protection_level_m"}
    found: float | None = evaluation.levels.filter(**wanted)["level_p50_m"].item()
    return found

"""``railfix simulate``: write the files of simulated runs, with ground truth."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from railfix.cli.console import progress_bar
from railfix.cli.options import check_set_once, from_models, set_value
from railfix.core.errors import SettingsError
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.run.output import Overwrite, check_folder
from railfix.simulate.scenario import Scenario
from railfix.simulate.scenario_file import Recipe, list_scenarios, load_recipe


class SimulateOptions(Settings):
    """Folder of the runs, and settings that override the scenario."""

    out: Path | None = option(
        "Folder for the files; each run of a recipe is written into a subfolder.", None, metavar="DIR", panel="Options"
    )
    seconds: float | None = option("Duration, in place of the duration in the scenario.", None, metavar="S", gt=0.0)
    seed: int | None = option("Seed of the random numbers, in place of the seed in the scenario.", None)
    setting: tuple[str, ...] = option(
        "Setting that overrides the scenario, such as --set receiver.code_sigma_m=0; may be repeated.",
        (),
        name="--set",
        metavar="KEY=VALUE",
    )
    only: tuple[str, ...] = option(
        "Simulate only this run of a recipe, given by its number (from 1) or name; may be repeated.", (), metavar="RUN"
    )
    packing: Literal["packed", "plain"] = option("Write uncompressed files: .rnx, .csv.", "packed", name="--plain")
    overwrite: Overwrite = option("Replace existing results.", "refuse", name="--overwrite")

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that override the scenario's settings; raise SettingsError if a key is given twice."""
        check_set_once(self.setting)
        changes: dict[str, Any] = {}
        for text in self.setting:
            set_value(changes, text)
        given = {"duration_s": self.seconds, "seed": self.seed}
        return changes | {name: value for name, value in given.items() if value is not None}

    @property
    def words(self) -> list[str]:
        """Words of a command line that would simulate the run again, without SCENARIO and --only."""
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
        typer.Argument(
            metavar="SCENARIO", help="Scenario file (TOML), or the name of a shipped scenario (see --list)."
        ),
    ] = None,
    list_shipped: Annotated[bool, typer.Option("--list", help="List the shipped scenarios and exit.")] = False,
) -> None:
    """Simulate runs of a train: logs of two antennas, navigation, track map, vehicle, sensors, and ground truth.

    SCENARIO defines the line (elements, a generated line, or a track file), the motion of the train, the satellites (a
    simulated constellation, or a navigation file), receivers, errors, obstacles along the line and on-board sensors. A
    recipe is a scenario file with several runs; each run is written to a separate folder. The same scenario always
    produces the same files.

    Example: `railfix simulate demo --out simulated`

    Exit codes are listed in `railfix --help`; the code is 5 if the navigation file does not cover the time of the
    scenario.
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
    from railfix.simulate.run import write_run  # imported here, because the import of scipy.signal takes 0.4 s

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
    """Return the indices (from 0) of the runs to simulate, in ascending order.

    Raise SettingsError if a run does not exist.
    """
    if not only:
        return list(range(len(recipe.names)))
    if not recipe.names[0]:
        raise SettingsError(f"--only {only[0]}: {recipe.path} is a single run; omit the option")
    numbers = []
    for word in only:
        if word in recipe.names:
            numbers.append(recipe.names.index(word))
        elif word.isdigit() and 1 <= int(word) <= len(recipe.names):
            numbers.append(int(word) - 1)
        else:
            raise SettingsError(
                f"--only {word}: {recipe.path} has no such run; it has {len(recipe.names)} runs, "
                f"{recipe.names[0]} to {recipe.names[-1]}"
            )
    return sorted(set(numbers))

"""``railfix simulate``: simulated runs as files, with ground truth."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from railfix.cli.console import progress_bar
from railfix.cli.options import OverwriteOption, overwriting
from railfix.cli.settings import check_set_once, set_value
from railfix.core.errors import SettingsError
from railfix.run.output import Overwrite, check_folder
from railfix.simulate.run import write_run
from railfix.simulate.scenario import Scenario
from railfix.simulate.scenario_file import Recipe, load_recipe, shipped_scenarios

_PANEL = "Choices"


def simulate(
    *,
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="SCENARIO", help="Scenario file (TOML), or the name of a shipped one, see --list."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the files; each run of a recipe in its own below it."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", metavar="S", rich_help_panel=_PANEL, help="Duration, overriding the scenario's."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", rich_help_panel=_PANEL, help="Seed, overriding the scenario's."),
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            rich_help_panel=_PANEL,
            help="One setting, overriding the scenario's: --set receiver.code_sigma_m=0; may be repeated.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            metavar="RUN",
            rich_help_panel=_PANEL,
            help="Only this run of a recipe, by its number from 1 or its name; may be repeated.",
        ),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", rich_help_panel=_PANEL, help="Write unpacked files: .rnx, .csv.")
    ] = False,
    overwrite: OverwriteOption = False,
    list_shipped: Annotated[bool, typer.Option("--list", help="Name the shipped scenarios and end.")] = False,
) -> None:
    """Simulate runs of a train: logs of two antennas, navigation, track map, vehicle, sensors, and ground truth.

    SCENARIO defines the line (elements, a generated one, or a track file), the motion of the train, the
    satellites (a simulated constellation, or a navigation file), receivers, errors, obstacles along the line and
    sensors on board. A recipe lists many runs, each written to its own folder. The same scenario gives the same
    files.

    Example:

        railfix simulate demo --out simulated

    Exit codes: 0 done; 2 the command line was misused; 3 a file that the scenario names is not what it
    should be; 4 a setting is wrong; 5 the navigation file does not serve the scenario's time; 8 DIR
    cannot be written, or has files in it; 1 a defect of railfix.
    """
    if list_shipped:
        for name in shipped_scenarios():
            recipe = load_recipe(name)
            runs = f" ({len(recipe.names)} runs)" if recipe.names[0] else ""
            typer.echo(f"{name:18} {recipe.description}{runs}")
        return
    if scenario is None or out is None:
        raise typer.BadParameter("give a SCENARIO and --out DIR, or --list")
    recipe = load_recipe(scenario)
    numbers = _choose_runs(recipe, only or [])
    replacing = overwriting(overwrite)
    folders = {number: out / recipe.names[number] for number in numbers}
    for folder in folders.values():
        check_folder(folder, overwrite=replacing)
    changes = _changes(setting or [], seconds, seed)
    scenarios = {number: recipe.scenario(number, changes=changes) for number in numbers}
    options = [
        *_words("--seconds", seconds),
        *_words("--seed", seed),
        *(w for s in setting or [] for w in ("--set", s)),
    ]
    _simulate(
        recipe,
        ["railfix", "simulate", scenario, "--out", str(out), *options],
        scenarios,
        folders,
        plain=plain,
        overwrite=replacing,
    )


def _simulate(
    recipe: Recipe,
    command: list[str],
    scenarios: dict[int, Scenario],
    folders: dict[int, Path],
    *,
    plain: bool,
    overwrite: Overwrite,
) -> None:
    done = 0
    files: dict[str, Path] = {}
    with progress_bar("simulation") as show:
        for at, (number, scenario) in enumerate(scenarios.items()):
            run = ["--only", recipe.names[number]] if recipe.names[number] else []
            packed = ["--plain"] if plain else []
            total, before = 2 * scenario.epochs, done

            def progress(_antenna: str, epochs: int, at: int = at, total: int = total, before: int = before) -> None:
                nonlocal done
                done += epochs
                show(epochs=done, fraction=(at + (done - before) / total) / len(scenarios))

            files = write_run(
                scenario,
                folders[number],
                packing="plain" if plain else "packed",
                command=shlex.join([*command, *run, *packed]),
                overwrite=overwrite,
                progress=progress,
            )
    if len(scenarios) == 1:
        for path in files.values():
            typer.echo(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB)")
    else:
        for folder in folders.values():
            typer.echo(f"wrote {folder}")
    typer.echo(f"{done:,} antenna-epochs")


def _choose_runs(recipe: Recipe, only: list[str]) -> list[int]:
    """Numbers of the runs to make, from 0."""
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


def _changes(setting: list[str], seconds: float | None, seed: int | None) -> dict[str, Any]:
    check_set_once(tuple(setting))
    changes: dict[str, Any] = {}
    for text in setting:
        set_value(changes, text)
    if seconds is not None and not seconds > 0.0:
        raise SettingsError(f"--seconds must be positive, got {seconds:g}")
    if seconds is not None:
        changes["duration_s"] = seconds
    if seed is not None:
        changes["seed"] = seed
    return changes


def _words(option: str, value: float | None) -> list[str]:
    return [] if value is None else [option, str(value)]

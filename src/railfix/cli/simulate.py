"""``railfix simulate``: simulated runs with ground truth, as files."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from railfix.core.errors import OutputError, SettingsError

if TYPE_CHECKING:
    from railfix.simulate.scenario import Scenario
    from railfix.simulate.scenario_file import Recipe

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
        typer.Option("--seconds", metavar="S", rich_help_panel=_PANEL, help="Duration, over the scenario's."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", rich_help_panel=_PANEL, help="Seed, over the scenario's."),
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            rich_help_panel=_PANEL,
            help="One setting, over the scenario's: --set receiver.code_sigma_m=0; may be repeated.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            metavar="RUN",
            rich_help_panel=_PANEL,
            help="Of a recipe this run alone, by its number from 1 or its name; may be repeated.",
        ),
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", rich_help_panel=_PANEL, help="Nothing packed: .rnx, .csv.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", rich_help_panel=_PANEL, help="Replace files that are already in DIR.")
    ] = False,
    list_shipped: Annotated[bool, typer.Option("--list", help="Name the shipped scenarios and end.")] = False,
) -> None:
    """Make up runs of a train: logs of two antennas, navigation, track map, vehicle, sensors, and the truth.

    SCENARIO says what: the line (elements, a generated one, or a track file), how the train runs, its
    sky (made, or a navigation file), receivers, errors, what stands along the line, sensors on board.
    A recipe lists many runs and makes each into its own folder. The same scenario gives the same files.

    Example:

        railfix simulate demo --out made

    Exit codes: 0 done; 2 the command line was misused; 3 a file that the scenario names is not what it
    should be; 4 a setting is wrong; 5 the navigation file does not serve the scenario's time; 8 DIR
    cannot be written, or has files in it; 1 a defect of railfix.
    """
    from railfix.simulate.scenario_file import load_recipe, shipped_scenarios

    if list_shipped:
        for name in shipped_scenarios():
            recipe = load_recipe(name)
            runs = f" ({len(recipe.names)} runs)" if recipe.names[0] else ""
            typer.echo(f"{name:18} {recipe.description}{runs}")
        return
    if scenario is None or out is None:
        raise typer.BadParameter("give a SCENARIO and --out DIR, or --list")
    recipe = load_recipe(scenario)
    numbers = _chosen(recipe, only or [])
    folders = {number: out / recipe.names[number] for number in numbers}
    if not overwrite:
        for folder in folders.values():
            if folder.is_dir() and any(folder.iterdir()):
                raise OutputError(f"{folder}: the folder is not empty; name another one, or give --overwrite")
    changes = _changes(setting or [], seconds, seed)
    scenarios = {number: recipe.scenario(number, changes=changes) for number in numbers}
    options = [*_said("--seconds", seconds), *_said("--seed", seed), *(w for s in setting or [] for w in ("--set", s))]
    _make(recipe, ["railfix", "simulate", scenario, "--out", str(out), *options], scenarios, folders, plain=plain)


def _make(
    recipe: Recipe,
    command: list[str],
    scenarios: dict[int, Scenario],
    folders: dict[int, Path],
    *,
    plain: bool,
) -> None:
    from railfix.cli.console import progress_bar
    from railfix.simulate.run import write_run

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
                progress=progress,
            )
    if len(scenarios) == 1:
        for path in files.values():
            typer.echo(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB)")
    else:
        for folder in folders.values():
            typer.echo(f"wrote {folder}")
    typer.echo(f"{done:,} antenna-epochs")


def _chosen(recipe: Recipe, only: list[str]) -> list[int]:
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
    from railfix.cli.settings import set_value

    changes: dict[str, Any] = {}
    for text in setting:
        set_value(changes, text)
    if seconds is not None:
        changes["duration_s"] = seconds
    if seed is not None:
        changes["seed"] = seed
    return changes


def _said(option: str, value: float | None) -> list[str]:
    return [] if value is None else [option, str(value)]

"""Scenario files in TOML: the settings of `Scenario` for one run, or a recipe of several runs.

With ``duration_s = "run"``, the run ends at the end of the last stop. A recipe names a base scenario (another file in
the same folder, or a shipped scenario), and the settings of each run that differ from the base::

    description = "two runs"
    base = "p1-commercial"

    [[runs]]
    name = "01-rising"
    seed = 1

    [[runs]]
    name = "02-falling"
    parts = ["back"]

    [parts.back]
    run.direction = "falling"

The settings of a run override the settings of its parts, and later parts override earlier parts. All these settings
override the base. Paths in a file (``sky.nav``, ``line.file.path``) are relative to the folder of the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import FilePath
from railfix.core.settings import validate
from railfix.core.settings_files import read_toml
from railfix.core.staged_files import check_path
from railfix.simulate.alignment import build_alignment
from railfix.simulate.motion import build_motion
from railfix.simulate.scenario import Scenario

#: Value of ``duration_s`` for a run that lasts until the last stop of the run curve.
WHOLE_RUN: Final = "run"
_FOLDER: Final = Path(__file__).resolve().parent / "scenarios"


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Content of a scenario file: the settings of one or several runs."""

    path: Path
    description: str
    names: tuple[str, ...]  #: Names of the runs; one empty name if the file has a single run.
    tables: tuple[Mapping[str, Any], ...]  #: Settings of each run; paths are absolute.

    def scenario(self, number: int = 0, *, changes: Mapping[str, Any] | None = None) -> Scenario:
        """Return the scenario of run `number` (from 0); the settings `changes` override the settings of the file.

        Raise SettingsError if a setting is misspelt, of the wrong type, or out of range, and InputFileError if the
        duration depends on a track file that cannot be read.
        """
        table = _over(self.tables[number], changes or {})
        to_the_end = table.get("duration_s") == WHOLE_RUN
        if to_the_end:
            del table["duration_s"]
        name = self.names[number]
        source = f"{self.path}, run {name}" if name else str(self.path)
        source += " with the settings of the command line" if changes else ""
        scenario = validate(Scenario, table, source=source)
        if not to_the_end:
            return scenario
        try:
            return scenario.replaced(duration_s=whole_run_s(scenario))
        except SettingsError as error:
            raise SettingsError(f"{source}: {error}") from None


def whole_run_s(scenario: Scenario) -> float:
    """Return the time to the end of the standstill after the first leg, rounded up to whole seconds [s]."""
    motion = build_motion(build_alignment(scenario.line), scenario, duration_s=0.0)
    run = scenario.run
    last = run.stations[-1 if run.direction == "rising" else 0].dwell_s if run.stations else run.stand_s
    return float(math.ceil(float(motion.time_s[-1]) + last))


def list_scenarios() -> dict[str, Path]:
    """Return the scenario files that come with railfix, by name."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"))}


def find_scenario(name: FilePath) -> Path:
    """Return the path of a scenario file, given by its path or as the name of a shipped scenario.

    Raise InputFileError if the name has no suffix and is neither an existing file nor a shipped scenario. A missing
    file with a suffix is reported when it is read.
    """
    shipped, path = list_scenarios(), Path(name)
    if path.is_file() or (path.suffix and str(name) not in shipped):
        return path
    if str(name) not in shipped:
        raise InputFileError(
            name, f"is neither a scenario file nor the name of a shipped scenario: {', '.join(shipped)}"
        )
    return shipped[str(name)]


def load_recipe(name: FilePath) -> Recipe:
    """Read a scenario file of one or several runs, given by its path or as the name of a shipped scenario.

    Raise InputFileError if the file is missing, unreadable, or not TOML, and SettingsError if a recipe is invalid
    (repeated names, unknown keys). The settings of a run are checked by `Recipe.scenario`.
    """
    check_path(name, what="a path or the name of a shipped scenario")
    path = find_scenario(name)
    table = read_toml(path, what="a scenario file")
    description = str(table.pop("description", ""))
    if "runs" not in table and "base" not in table:
        return Recipe(path=path, description=description, names=("",), tables=(_absolute(table, path),))
    unknown = sorted(set(table) - {"base", "runs", "parts"})
    if unknown:
        raise SettingsError(f"{path}: unknown key {unknown[0]} in a recipe; expected description, base, parts, runs")
    runs = table.get("runs")
    if not isinstance(runs, list) or not runs or not all(isinstance(run, dict) for run in runs):
        raise SettingsError(f"{path}: a recipe lists its runs as [[runs]], each with a name and its own settings")
    base: Mapping[str, Any] = {}
    if "base" in table:
        beside = path.parent / str(table["base"])
        if beside.is_file() and beside.samefile(path):
            raise SettingsError(f"{path}: is based on itself; name a single run as base")
        below = load_recipe(beside if beside.is_file() else str(table["base"]))
        if len(below.names) > 1 or below.names[0]:
            raise SettingsError(f"{path}: base {table['base']!r} is a recipe itself; name a single run")
        base = below.tables[0]
    names = [run.get("name", "") for run in runs]
    for name_of in names:
        if not isinstance(name_of, str) or not re.fullmatch(r"[\w.-]*\w", name_of) or names.count(name_of) > 1:
            raise SettingsError(
                f"{path}: each of [[runs]] needs a unique name, which names its folder (letters, digits, - and _, "
                f"and dots except at the end), got {name_of!r}"
            )
    tables = tuple(_run_table(base, run, table.get("parts", {}), path) for run in runs)
    return Recipe(path=path, description=description, names=tuple(names), tables=tables)


def _run_table(
    base: Mapping[str, Any], run: Mapping[str, Any], parts: Mapping[str, Any], path: Path
) -> Mapping[str, Any]:
    """Return the settings of a run: the base, overridden by the parts that the run names, then by the run's own
    settings.
    """
    for name in run.get("parts", []):
        if not isinstance(parts.get(name), dict):
            raise SettingsError(f"{path}: [parts] has no table {name!r}; its tables are {', '.join(parts) or 'none'}")
        base = _over(base, _absolute(parts[name], path))
    return _over(base, _absolute({key: run[key] for key in run if key not in ("name", "parts")}, path))


def load_scenario(name: FilePath) -> Scenario:
    """Read the scenario of a file with one run, given by its path or as the name of a shipped scenario.

    Raise InputFileError if the file is missing, unreadable, or not TOML, and SettingsError if a setting is misspelt, of
    the wrong type, or out of range, or the file has several runs.
    """
    recipe = load_recipe(name)
    if recipe.names[0]:
        raise SettingsError(f"{recipe.path}: lists {len(recipe.names)} runs, expected one; use load_recipe")
    return recipe.scenario()


def scenario_table(scenario: Scenario) -> dict[str, Any]:
    """Return all settings of a scenario as the content of a scenario file.

    None is represented by the word "none"; `multipath` is left out.
    """
    return dict(_without_none(scenario.model_dump()))


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [_without_none(part) for part in value]
    return "none" if value is None else value


def _absolute(table: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return settings in which paths relative to the folder of `path` are replaced by absolute paths."""
    changes: dict[str, Any] = {}
    sky, line = table.get("sky"), table.get("line")
    if isinstance(sky, dict) and isinstance(sky.get("nav"), str) and sky["nav"] != "none":
        changes["sky"] = {"nav": str(path.resolve().parent / sky["nav"])}
    if isinstance(line, dict) and isinstance(file := line.get("file"), dict) and isinstance(file.get("path"), str):
        changes["line"] = {"file": {"path": str(path.resolve().parent / file["path"])}}
    return _over(table, changes)


def _over(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings `base` overridden by `values`; tables in both are merged."""
    both = {**base, **values}
    for name in set(base) & set(values):
        if isinstance(base[name], Mapping) and isinstance(values[name], Mapping):
            both[name] = _over(base[name], values[name])
    return both

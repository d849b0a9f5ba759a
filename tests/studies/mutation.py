"""Score of the tests of a package: bugs put into its source, one at a time, and how many make a test fail.

Run ``python tests/studies/mutation.py live --sample 40 --seed 1``. The tests of the room, of a package in it the files
that name it (``--tests`` for others) run once under `coverage`, which notes the tests that pass each line. Every mutant
changes one operator, comparison, number, condition or statement in a temporary copy of the source; the tests that pass
its lines run against it, of fixtures those of the whole file, of lines that run at import all. A mutant is killed where
a test fails, or where they take three times as long as all did under `coverage`. The score is the killed share of the
mutants on lines that a test passes and of those that none does; survivors are printed with their place.
"""

from __future__ import annotations

import argparse
import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import paths

SOURCE: Final = paths.ROOT / "src" / "railfix"
#: Floor of killed mutants of a package [%]; below it the exit code is 1.
FLOORS: Final = {"live": 80, "motion": 80, "report": 80, "io/receiver": 80}
_PAIRS: Final = (
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr), (ast.And, ast.Or), (ast.Lt, ast.LtE),
    (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.In, ast.NotIn), (ast.Is, ast.IsNot),
)  # fmt: skip
SWAPS: Final[dict[type, type]] = {a: b for pair in _PAIRS for a, b in (pair, pair[::-1])} | {ast.Pow: ast.Mult}


class Mutant(NamedTuple):
    """A change of the node with a number in a module's tree."""

    module: str
    node: int
    line: int
    change: str


def changed(node: ast.AST) -> tuple[ast.AST, str] | None:
    """The node with a bug, and its description; None where nothing is to be changed."""
    new = copy.deepcopy(node)
    match new:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            new.op = SWAPS[type(op)]()
        case ast.Compare(ops=[op]) if type(op) in SWAPS:
            new.ops = [SWAPS[type(op)]()]
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert()):
            new = new.operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value) | float(value)):
            new.value = value + 1
        case ast.AugAssign():
            new = ast.Pass()
        case ast.Call(args=[first, _, *_], func=ast.Attribute(attr="hypot" | "maximum" | "minimum")):
            new = first
        case _:
            return None
    return new, f"{ast.unparse(node)[:70]}  ->  {ast.unparse(new)[:70]}"


def code_nodes(tree: ast.AST, *, inside: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """All nodes of a tree in a fixed order, and whether they may be changed: not annotations, errors, decorators."""
    for name, value in ast.iter_fields(tree):
        free = inside and name not in ("annotation", "returns", "decorator_list") and not isinstance(tree, ast.Raise)
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield child, free
                yield from code_nodes(child, inside=free or isinstance(child, ast.FunctionDef))


def mutants_of(package: str) -> list[Mutant]:
    """Every possible mutant of the functions of a package, or of a module."""
    mutants, module = [], SOURCE / f"{package}.py"
    for path in [module] if module.is_file() else sorted((SOURCE / package).rglob("*.py")):
        for number, (node, free) in enumerate(code_nodes(ast.parse(path.read_text(encoding="utf-8")))):
            if free and (result := changed(node)) is not None:
                mutants.append(
                    Mutant(path.relative_to(SOURCE).as_posix(), number, getattr(node, "lineno", 0), result[1])
                )
    return mutants


def mutated(text: str, mutant: Mutant) -> str:
    """Source of a module with the mutant in it."""
    tree = ast.parse(text)
    target = next(node for number, (node, _) in enumerate(code_nodes(tree)) if number == mutant.node)
    new, _ = changed(target) or (target, "")
    target.__class__, target.__dict__ = type(new), vars(new)
    return ast.unparse(ast.fix_missing_locations(tree))


#: Plugin of pytest that notes the running test, and whether it is in its fixtures, as the context of `coverage`.
_PLUGIN: Final = """
import json, os, pathlib, coverage, pytest
measured = coverage.Coverage(data_file=os.environ["MEASURED"], source_pkgs=["railfix"], config_file=False)
measured.set_option("run:disable_warnings", ["module-not-measured", "already-imported"])
measured.start()
@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item): measured.switch_context(item.nodeid + "|setup")
@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item): measured.switch_context(item.nodeid + "|run")
times = {}
def pytest_runtest_logreport(report):
    for name in (report.nodeid.partition("[")[0], report.nodeid.partition("::")[0]):
        times[name] = times.get(name, 0.0) + report.duration
def pytest_sessionfinish():
    measured.stop()
    measured.save()
    pathlib.Path(os.environ["MEASURED"] + ".json").write_text(json.dumps(times))
"""


class Tests:
    """Tests of some folders, and those that pass a line of the source."""

    def __init__(self, source: Path, folders: Sequence[str], folder: Path) -> None:
        from coverage import CoverageData

        (folder / "measuring.py").write_text(_PLUGIN)
        self.source, self._folders, self._data = source, folders, CoverageData(str(folder / "measured"))
        began = time.monotonic()
        if not self.pass_within(3600.0, [*folders, "-p", "measuring"], {"MEASURED": str(folder / "measured")}):
            sys.exit(
                f"tests of {' '.join(folders)} must pass, also under coverage, before mutants are tried: {self.said}"
            )
        self.limit_s = max(120.0, 3.0 * (time.monotonic() - began))
        self._data.read()
        self._times = json.loads((folder / "measured.json").read_text())

    def at(self, module: str, line: int) -> list[str]:
        """Return the tests that pass a line, quickest first: functions, or whole files by a fixture or import."""
        found, contexts = set(), self._data.contexts_by_lineno(str(self.source / "railfix" / module)).get(line, ())
        if list(contexts) == [""]:
            return list(self._folders)
        for context in contexts:
            test, _, when = context.rpartition("|")
            found.add(test.partition("[")[0] if when == "run" else test.partition("::")[0])
        some = [test for test in found if test and not ("::" in test and test.partition("::")[0] in found)]
        return sorted(some, key=lambda test: self._times.get(test, 0.0))

    def pass_within(self, limit_s: float, words: Sequence[str], environment: dict[str, str] | None = None) -> bool:
        """Return whether tests pass against the copy of the source within a time."""
        found = [str(self.source), str(self.source.parent)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(found), "OPENBLAS_NUM_THREADS": "1"} | (
            environment or {}
        )
        command = [sys.executable, "-m", "pytest", "-n0", "-q", "-x", "-p", "no:cacheprovider", *words]
        try:
            done = subprocess.run(
                command, cwd=paths.ROOT, env=environment, capture_output=True, timeout=limit_s, check=False
            )
        except subprocess.TimeoutExpired:
            return False
        self.said = (done.stdout + done.stderr).decode()[-1000:]
        if done.returncode > 2:  # no test ran: neither passed nor failed
            sys.exit(f"pytest ended with {done.returncode}: {self.said}")
        return done.returncode == 0


def tests_of(package: str) -> list[str]:
    """Return the tests of a room, or of a package in it the files that name it, as arguments of pytest."""
    room, _, inner = package.partition("/")
    name = f"railfix.{package.replace('/', '.')}"
    files = sorted((paths.ROOT / "tests" / room).rglob("test_*.py")) if inner else []
    naming = [f.relative_to(paths.ROOT).as_posix() for f in files if name in f.read_text(encoding="utf-8")]
    return naming or [f"tests/{room}"]


def main() -> None:
    """Draw mutants, run the tests, print survivors and the score; exit code 1 below the floor of the package."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("package", help="for example ranges, integrity, ranges/sbas or positioning/map_offset")
    parser.add_argument("--sample", type=int, default=40, help="mutants to draw (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tests", nargs="*", help="folders or files of tests (default: those of the room)")
    parser.add_argument("--minutes", type=float, default=60.0, help="no new mutant is begun after so long (default 60)")
    options = parser.parse_args()
    pool, started, killed, done = mutants_of(options.package), time.monotonic(), 0, 0
    if not pool:
        sys.exit(f"no functions under {SOURCE / options.package}; give a package, for example ranges or ranges/sbas")
    drawn = random.Random(options.seed).sample(pool, min(options.sample, len(pool)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(SOURCE, folder / "src" / "railfix")  # with the compiled kernels
        (folder / "data").symlink_to(paths.ROOT / "data")
        tests = Tests(folder / "src", options.tests or tests_of(options.package), folder)
        for mutant in drawn:
            if time.monotonic() - started > 60.0 * options.minutes:
                break
            module, at = folder / "src" / "railfix" / mutant.module, tests.at(mutant.module, mutant.line)
            text = module.read_text(encoding="utf-8")
            module.write_text(mutated(text, mutant), encoding="utf-8")
            survived = not at or tests.pass_within(tests.limit_s, at)
            module.write_text(text, encoding="utf-8")
            done, killed = done + 1, killed + (not survived)
            if survived:
                seen = f"{len(at)} tests pass it" if at else "no test passes it"
                print(f"survived {mutant.module}:{mutant.line}  {mutant.change}  ({seen})", flush=True)
    share = 100.0 * killed / max(done, 1)
    print(f"{options.package}: {killed} of {done} mutants killed ({share:.0f} %), "
          f"seed {options.seed}, {len(pool)} possible, {time.monotonic() - started:.0f} s")  # fmt: skip
    sys.exit(share < FLOORS.get(options.package, 0))


if __name__ == "__main__":
    main()

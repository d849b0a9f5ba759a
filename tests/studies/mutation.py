"""Score of the tests of a package: bugs put into its source, one at a time, and how many make a test fail.

Run ``python tests/studies/mutation.py ranges --sample 40 --seed 1``. Every mutant changes one operator, comparison,
number, condition or statement in a temporary copy of the source; the test files that belong to the module run against
it. A mutant is killed where a test fails or exceeds its time. The score is the killed share; survivors are printed with
their place, so that a test can be written for each.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import paths

SOURCE: Final = paths.ROOT / "src" / "railfix"
#: Test files by the beginning of a module's path, the longest that fits; quick ones first.
TESTS: Final = {
    "ranges": "range_corrections atmosphere sbas_pipeline pipeline_reasons conventional_rtklib",
    "core/settings": "settings error_model cn0_curve",
    "ranges/sbas": "sbas_corrections sbas_ionosphere sbas_reading sbas_decoding sbas_issues sbas_state sbas_spans "
    "sbas_rtklib sbas_hour",
    "ranges/error_model": "error_model range_corrections range_errors",
    "ranges/cn0_curve": "cn0_curve screens_cn0",
    "integrity": "raim_model protection_level stanford",
    "integrity/raim": "raim_model raim_detection raim_exclusion raim_reliability",
    "integrity/protection": "protection_risk protection_sides protection_sbas protection_level protection_separation",
    "positioning/map_offset": "map_offset",
    "pipeline/sensor_epochs": "sensor_epochs",
    "pipeline/received": "received",
    "pipeline/along_track": "train_output tracking",
    "pipeline/train_table": "train_output",
    "integrity/protection/open_places": "open_places",
    "pipeline/locate": "locate",
    "pipeline": "pipeline_reasons settings range_corrections sbas_pipeline carrier_stage screen_columns "
    "pipeline_couplings pipeline",
}
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


def test_files(module: str) -> tuple[str, ...]:
    """Test files of a module."""
    key = max((key for key in TESTS if module.startswith(key)), key=len, default="")
    return tuple(str(next((paths.ROOT / "tests").glob(f"*/test_{name}.py"))) for name in TESTS.get(key, "").split())


def passes(source: Path, files: tuple[str, ...], limit_s: float) -> bool:
    """Whether the tests pass against a copy of the source within a time."""
    environment = {**os.environ, "PYTHONPATH": str(source), "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    environment["NUMBA_CACHE_DIR"] = str(source / "compiled")  # of the source that is changed
    command = [sys.executable, "-m", "pytest", "-n0", "-q", "-x", "-p", "no:cacheprovider", *files]
    try:
        done = subprocess.run(
            command, cwd=paths.ROOT, env=environment, capture_output=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def main() -> None:
    """Draw mutants, run the tests, print survivors and the score."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("package", help="for example ranges, integrity, ranges/sbas or positioning/map_offset")
    parser.add_argument("--sample", type=int, default=40, help="mutants to draw (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=30.0, help="no new mutant is begun after so long (default 30)")
    options = parser.parse_args()
    pool, started, limits, killed, done = mutants_of(options.package), time.monotonic(), {}, 0, 0
    if not pool:
        sys.exit(f"no functions under {SOURCE / options.package}; give a package, for example ranges or ranges/sbas")
    drawn = random.Random(options.seed).sample(pool, min(options.sample, len(pool)))
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "src" / "railfix"
        shutil.copytree(SOURCE, copied, ignore=shutil.ignore_patterns("__pycache__"))
        (Path(folder) / "data").symlink_to(paths.ROOT / "data")
        for mutant in drawn:
            if time.monotonic() - started > 60.0 * options.minutes:
                break
            files = test_files(mutant.module)
            if files not in limits:
                before = time.monotonic()
                if not files or not passes(copied.parent, files, 900.0):
                    sys.exit(f"the tests of {mutant.module} must pass before mutants are tried: {' '.join(files)}")
                limits[files] = 30.0 + 3.0 * (time.monotonic() - before)
            text = (copied / mutant.module).read_text(encoding="utf-8")
            (copied / mutant.module).write_text(mutated(text, mutant), encoding="utf-8")
            survived = passes(copied.parent, files, limits[files])
            (copied / mutant.module).write_text(text, encoding="utf-8")
            done, killed = done + 1, killed + (not survived)
            if survived:
                print(f"survived {mutant.module}:{mutant.line}  {mutant.change}", flush=True)
    print(f"{options.package}: {killed} of {done} mutants killed ({100.0 * killed / max(done, 1):.0f} %), "
          f"seed {options.seed}, {len(pool)} possible, {time.monotonic() - started:.0f} s")  # fmt: skip


if __name__ == "__main__":
    main()

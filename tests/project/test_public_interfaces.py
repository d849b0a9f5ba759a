"""Only documented interfaces of other packages, found in the syntax trees of `src`."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

import pytest

SRC: Final = Path(__file__).resolve().parents[2] / "src" / "railfix"
#: Files that may do what is forbidden, with the reason.
EXCEPTIONS: Final[dict[str, str]] = {
    # and none by which acknowledgements wait, or a server takes turns between its connections and new ones
    "ground/quic.py": "aioquic has no public setting by which a server asks a client for its certificate"
}
#: Names with an underscore that the standard library documents.
DOCUMENTED: Final = frozenset({"_replace", "_fields", "_asdict", "_make", "_field_defaults", "_missing_"})
#: Packages, or parts of them, that are the insides of another.
INSIDES: Final = ("llvmlite", *(f"numba.{part}" for part in "core np cpython parfors typed.typedobjectutils".split()))
_NODES: Final = "Import ImportFrom FunctionDef AsyncFunctionDef ClassDef Name Attribute Call Assign Delete AugAssign"
NODES: Final = (ast.AnnAssign, *(getattr(ast, name) for name in _NODES.split()))
CALLS: Final = frozenset({"exec", "eval", "gc.disable", "gc.freeze", "gc.unfreeze", "importlib.util.LazyLoader"})


@cache
def nodes(tree: ast.Module) -> list[ast.AST]:
    return [node for node in ast.walk(tree) if isinstance(node, NODES)]


def is_private(name: str) -> bool:
    return name.startswith("_") and not (name.startswith("__") and name.endswith("__"))


def dotted(node: ast.expr) -> list[str]:
    """The names of ``a.b.c``; empty for anything that is not built of names alone."""
    if isinstance(node, ast.Name):
        return [node.id]
    if isinstance(node, ast.Attribute) and (before := dotted(node.value)):
        return [*before, node.attr]
    return []


def own_names(trees: list[ast.Module]) -> frozenset[str]:
    """Private names that the package itself defines: functions, classes, variables, fields, attributes of `self`."""
    found = set(DOCUMENTED)
    for tree in trees:
        for node in nodes(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                found.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.id)
            elif (
                isinstance(node, ast.Attribute)
                and isinstance(node.ctx, ast.Store)
                and isinstance(node.value, ast.Name)
                and node.value.id in ("self", "cls")
            ):
                found.add(node.attr)
    return frozenset(name for name in found if is_private(name))


def imported_names(tree: ast.Module) -> dict[str, str]:
    """What each name that an import binds stands for, railfix's own left out."""
    found = {}
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            for item in node.names:
                found[item.asname or item.name.partition(".")[0]] = (
                    item.name if item.asname else item.name.split(".")[0]
                )
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found |= {item.asname or item.name: f"{node.module}.{item.name}" for item in node.names}
    return {name: of for name, of in found.items() if of.partition(".")[0] not in ("railfix", "__future__")}


def is_third_party(name: str) -> bool:
    return name.partition(".")[0] not in sys.stdlib_module_names


def _imports(node: ast.stmt) -> Iterator[str]:
    names: list[str] = []
    if isinstance(node, ast.Import):
        names = [item.name for item in node.names]
    elif isinstance(node, ast.ImportFrom) and not node.level:
        names = [f"{node.module}.{item.name}" for item in node.names]
    for name in names:
        if any(f"{name}.".startswith(f"{part}.") for part in INSIDES):
            yield f"insides: {name}"
        elif not name.startswith(("railfix.", "__future__", "_typeshed.")) and any(map(is_private, name.split("."))):
            yield f"private: {name}"
        if name in CALLS:
            yield f"trick: {name}"


def _uses(node: ast.AST, imported: dict[str, str], own: frozenset[str]) -> Iterator[str]:
    if isinstance(node, ast.Attribute):
        if is_private(node.attr) and node.attr not in own:
            yield f"private: {ast.unparse(node)}"
        names = dotted(node)
        if names and names[0] in imported:
            full = ".".join([imported[names[0]], *names[1:]])
            if full.startswith(INSIDES):
                yield f"insides: {full}"
            if full in CALLS:
                yield f"trick: {full}"
    if isinstance(node, ast.Call):
        function = dotted(node.func)
        if function in (["exec"], ["eval"]):
            yield f"trick: {function[0]}"
        if function and function[-1] in ("getattr", "setattr", "hasattr", "delattr") and len(node.args) > 1:
            target, name = node.args[:2]
            if isinstance(name, ast.Constant) and is_private(str(name.value)) and name.value not in own:
                yield f"private: {ast.unparse(node)}"
            names = dotted(target)
            if function[-1] in ("setattr", "delattr") and names and is_third_party(imported.get(names[0], "sys")):
                yield f"assignment: {ast.unparse(node)}"
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.Delete):
        targets = node.targets
    elif isinstance(node, ast.AugAssign | ast.AnnAssign):
        targets = [node.target]
    for target in targets:
        for part in ast.walk(target):
            if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store | ast.Del):
                names = dotted(part)
                if names and names[0] in imported and is_third_party(imported[names[0]]):
                    yield f"assignment: {ast.unparse(part)}"
            if isinstance(part, ast.Subscript) and dotted(part.value) == ["sys", "modules"]:
                yield "assignment: sys.modules"


def find_faults(source: str | ast.Module, own: frozenset[str] = frozenset()) -> list[str]:
    """What of a source is forbidden, with its line."""
    tree = ast.parse(source) if isinstance(source, str) else source
    imported, known = imported_names(tree), own | own_names([tree])
    found = []
    for node in nodes(tree):
        faults = [*(_imports(node) if isinstance(node, ast.stmt) else ()), *_uses(node, imported, known)]
        found += [f"line {getattr(node, 'lineno', 0)}: {fault}" for fault in faults]
    return found


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    return {str(path.relative_to(SRC)): path.read_text(encoding="utf-8") for path in sorted(SRC.rglob("*.py"))}


@pytest.mark.requirement("S2")
def test_only_documented_interfaces_of_other_packages_are_used(sources: dict[str, str]) -> None:
    trees = {name: ast.parse(text) for name, text in sources.items()}
    own = own_names([*trees.values()])
    found = {name: faults for name, tree in trees.items() if (faults := find_faults(tree, own))}
    assert {name: faults for name, faults in found.items() if name not in EXCEPTIONS} == {}
    assert {name for name in EXCEPTIONS if name in sources} <= set(found), "an exception is no longer needed"


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("from numba.core import types", "insides"),
        ("import numba\nnumba.core.types.float64", "insides"),
        ("from llvmlite import ir", "insides"),
        ("import scipy._lib", "private"),
        ("from scipy._lib.doccer import inherit", "private"),
        ("import numpy as np\nnp._NoValue", "private"),
        ("from aioquic import connection\nconnection.Quic()._initialize()", "private"),
        ("def work(quic):\n    quic._initialize = 1", "private"),
        ("from http.server import Server\nclass Own(Server):\n    def run(self):\n        self._handle()", "private"),
        ("def work(table):\n    return getattr(table, '_df')", "private"),
        ("import numba\nnumba.config.DISABLE_JIT = True", "assignment"),
        ("from numba import config\nconfig.DISABLE_JIT = True", "assignment"),
        ("from polars import DataFrame\ndef own(self): ...\nDataFrame.show = own", "assignment"),
        ("import numpy as np\nsetattr(np, 'sum', max)", "assignment"),
        ("import numpy as np\ndel np.sum", "assignment"),
        ("import sys\nsys.modules['numpy.testing'] = None", "assignment"),
        ("exec('x = 1')", "trick"),
        ("import gc\ngc.disable()", "trick"),
        ("from importlib.util import LazyLoader", "trick"),
    ],
)
def test_each_kind_is_found(source: str, kind: str) -> None:
    faults = find_faults(source)
    assert faults
    assert any(f": {kind}: " in fault for fault in faults), faults


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np\nnp.linalg.norm",
        "from railfix.kernels._own import _f",
        "class Own:\n    def __init__(self):\n        self._x = 1\n    def y(self, other):\n        return other._x",
        "def work(row):\n    return row._replace(a=1)",
        "import numpy as np\nx = np.zeros(3)\nx[0] = 1.0",
        "class Own:\n    x = 1\nOwn.x = 2",
    ],
)
def test_own_and_documented_names_are_not(source: str) -> None:
    assert find_faults(source) == []

"""Only what a compiler gets may lack type hints, and mypy is told of exactly the modules that hold such functions."""

import ast
from pathlib import Path

import pytest

try:
    import tomllib
except ModuleNotFoundError:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
COMPILING = {"kernel", "bare_kernel", "rule", "device", "intrinsic"}


def unhinted(tree: ast.AST, compiled: bool = False) -> list[tuple[str, bool]]:
    """Return name and "does a compiler get it?" of each function below ``tree`` whose hints are not complete."""
    found = []
    for node in ast.iter_child_nodes(tree):
        is_compiled = compiled
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
            is_compiled = compiled or bool(decorators & COMPILING)
            if not has_hints(node):
                found.append((node.name, is_compiled))
        found += unhinted(node, is_compiled)
    return found


def has_hints(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    others = [argument for argument in (given.vararg, given.kwarg) if argument]
    hinted = all(a.annotation or a.arg in ("self", "cls") for a in named + others)
    return hinted and (function.returns is not None or function.name == "__init__")


def modules() -> dict[str, list[tuple[str, bool]]]:
    """Return what lacks hints in each module of the package that has any such function."""
    found = {}
    for path in sorted((ROOT / "src" / "headvox").rglob("*.py")):
        without = unhinted(ast.parse(path.read_text(encoding="utf-8")))
        if without:
            found[".".join(path.relative_to(ROOT / "src").with_suffix("").parts)] = without
    return found


def test_only_compiled_functions_lack_hints():
    plain = [
        f"{module}.{name}" for module, names in modules().items() for name, compiled in names if not compiled
    ]
    assert not plain, "these functions need type hints"


def test_mypy_lets_exactly_the_modules_with_kernels_off():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    let_off = [rule["module"] for rule in settings["overrides"] if "disallow_untyped_defs" in rule]
    assert let_off == [list(modules())]


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("def f(a: int) -> int: ...", []),
        ("def f(a): ...", [("f", False)]),
        ("def f(a: int): ...", [("f", False)]),
        ("async def f(*a) -> None: ...", [("f", False)]),
        ("class C:\n    def m(self, a) -> None: ...", [("m", False)]),
        ("if True:\n    @kernel\n    def f(a): ...", [("f", True)]),
        ("@wraps(f)\ndef f(a): ...", [("f", False)]),
        ("@intrinsic\ndef f(a):\n    def emit(b): ...", [("f", True), ("emit", True)]),
        ("@kernel\ndef f(a): ...\ndef g(a): ...", [("f", True), ("g", False)]),
    ],
)
def test_what_counts_as_lacking_hints(code, found):
    assert unhinted(ast.parse(code)) == found

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from operator import attrgetter
from pathlib import Path

import pytest

import headvox

HEAVY = ("numba", "scipy", "PIL", "llvmlite", "matplotlib", "rich", "tyro")


def loaded_after(code: str) -> set[str]:
    """Return the top-level packages that a fresh interpreter has loaded after ``code``."""
    script = f"{code}\nimport sys\nprint(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "module", ["headvox", "headvox.data", "headvox.errors", "headvox.config", "headvox.masks.cascade"]
)
def test_import_waits_for_nothing_heavy(module):
    assert not loaded_after(f"import {module}") & set(HEAVY)


def test_import_alone_loads_no_numpy():
    assert "numpy" not in loaded_after("import headvox")


def test_data_classes_need_no_numba():
    code = "import headvox\nheadvox.Frame(0); headvox.Heads(); headvox.HeadvoxError('x')"
    assert not loaded_after(code) & set(HEAVY)


def test_public_names_resolve():
    for name in headvox.__all__:
        assert getattr(headvox, name) is not None
    assert set(headvox.__all__) == set(dir(headvox))
    assert headvox.Detector.__module__ == "headvox.pipeline"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'headvox' has no attribute 'Detektor'"):
        attrgetter("Detektor")(headvox)


def test_the_version_is_the_packages():
    from importlib.metadata import version

    assert headvox.__version__ == version("headvox")


def imported_by(node: ast.AST) -> set[str]:
    """Return what code imports, in functions too; what only a type checker sees does not count."""
    found = set()
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ImportFrom):
            found |= {f"{child.module}.{name.name}" for name in child.names}
        elif isinstance(child, ast.Import):
            found |= {name.name for name in child.names}
        elif not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            found |= imported_by(child)
    return found


def test_no_two_modules_need_each_other():
    package = Path(headvox.__file__).parent
    trees = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package.parent).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        trees[module] = ast.parse(path.read_text(encoding="utf-8"))
    needs = {
        module: {name if name in trees else name.rpartition(".")[0] for name in imported_by(tree)}
        for module, tree in trees.items()
    }
    assert needs["headvox.sources.ply"] >= {"headvox.sources.content", "numpy"}
    TopologicalSorter(needs).prepare()  # raises CycleError, which names them

"""The package is as its docstring says: every module named, in the order of use."""

import ast
import fnmatch
import re
from pathlib import Path

import pytest

import ginn_jax

FOLDER = Path(ginn_jax.__file__).parent
MODULES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem != "__init__")
TABLE = ginn_jax.__doc__.split("before it:")[1].split("Shape letters")[0]
NAMES = re.findall(r"^ {4}([\w*]+(?:, [\w*]+)*) ", TABLE, re.MULTILINE)
LISTED = [name for line in NAMES for name in line.split(", ")]


def place(module):
    """Where the docstring names a module, by its own name or by a pattern."""
    exact = [i for i, name in enumerate(LISTED) if name == module]
    return (exact or [i for i, n in enumerate(LISTED) if fnmatch.fnmatch(module, n)])[0]


def imported(module):
    """The modules of the package that a module takes something from."""
    tree = ast.parse((FOLDER / f"{module}.py").read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "ginn_jax":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module.startswith("ginn_jax."):
            yield node.module.removeprefix("ginn_jax.")


def test_every_module_is_listed_once_and_nothing_else():
    assert len(set(LISTED)) == len(LISTED)
    for name in LISTED:
        assert fnmatch.filter(MODULES, name), f"{name} is no module"
    for module in MODULES:
        place(module)


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_what_stands_before_it(module):
    later = [name for name in imported(module) if place(name) > place(module)]
    assert not later

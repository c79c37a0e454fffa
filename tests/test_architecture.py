"""The rules that hold the tree together: which package may import which, and the README's commands."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# What each package may import of the project, beside itself.
ALLOWED = {
    "robots": set(),
    "bus": {"robots"},
    "plant": {"robots", "bus"},
    "joint_firmware": {"robots", "bus"},
    "central_controller": {"robots", "bus"},
}


def imported(path: Path) -> set[str]:
    """Top-level names of all that a module imports, at any depth of its code."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_point_one_way(package: str) -> None:
    modules = sorted((ROOT / package).rglob("*.py"))
    assert modules
    ours = {*ALLOWED, "hil"}
    for module in modules:
        foreign = imported(module) & ours - ALLOWED[package] - {package}
        assert not foreign, f"{module.relative_to(ROOT)} imports {', '.join(sorted(foreign))}"


def test_the_readme_s_first_two_commands_set_up_by_themselves() -> None:
    """Whoever has nothing but Python copies them: each makes the environment that it needs."""
    commands = re.findall(r"^    (.+)$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)[:2]
    for command, purpose in zip(commands, ("hil run split-terrain", "-m pytest"), strict=True):
        assert command.startswith("python3 -m venv .venv && .venv/bin/pip install")
        assert purpose in command

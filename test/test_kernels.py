# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import ast
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_FILES = [path for folder in ("g2_recon", "test", "benchmarks") for path in sorted((_ROOT / folder).rglob("*.py"))]


def test_python_calls_no_inner_kernel() -> None:
    trees = {path: ast.parse(path.read_text()) for path in _FILES}
    inner = {(_module(path), each.name) for path, tree in trees.items() for each in _kernels(tree, "inner_kernel")}
    assert len(inner) > 10
    for path, tree in trees.items():
        meant = {name: (_module(path), name) for name in (each.name for each in _kernels(tree, "inner_kernel"))}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                meant |= {each.asname or each.name: (node.module, each.name) for each in node.names}
        in_kernels = {node for each in _kernels(tree, "kernel") for part in each.body for node in ast.walk(part)}
        for node in set(ast.walk(tree)) - in_kernels:
            called = isinstance(node, ast.Name) and meant.get(node.id) in inner
            of_module = isinstance(node, ast.Attribute) and node.attr in {name for _, name in inner}
            assert not (called or of_module), f"{path}:{node.lineno}"


def _module(path: Path) -> str:
    return ".".join(path.relative_to(_ROOT).with_suffix("").parts)


def _kernels(tree: ast.Module, decorator: str) -> list[ast.FunctionDef]:
    """Functions with a decorator whose name ends so."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(each).split("(")[0].endswith((decorator, "njit")) for each in node.decorator_list)
        and (decorator != "inner_kernel" or "inner_kernel" in ast.unparse(node.decorator_list[0]))
    ]

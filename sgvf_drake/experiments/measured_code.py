"""Which code decides the numbers of a trial, as a digest.

The function that measures a trial counts with what it uses of its own module, so that the
claims and figures beside it do not count; every module of ours that these import counts as a
whole, and so does what that imports.  Comments, docstrings and the annotations of functions
decide no number and do not count.
"""

import ast
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
import hashlib
import inspect
from pathlib import Path
from typing import Any

import sgvf_drake
import systems

_ROOTS = {root.__name__: Path(root.__file__ or "").parent for root in (sgvf_drake, systems)}


@cache
def code_digest(*roots: Any) -> str:
    """Returns a digest of the code under functions and classes, as it is when first asked."""
    names: dict[Path, set[str]] = {}
    for root in roots:
        # What is defined inside of a function counts with all of that function.
        names.setdefault(Path(inspect.getfile(root)), set()).add(
            root.__qualname__.split(".")[0]
        )
    own = {file: _code_of(file, frozenset(of_file)) for file, of_file in names.items()}
    imported: dict[Path, _Code] = {}
    new = {file for code in own.values() for file in code.imports}
    while new:
        imported |= {file: _code_of(file) for file in new}
        new = {found for file in new for found in imported[file].imports} - imported.keys()
    digest = hashlib.sha256()
    # By the name, which is the same wherever the package is installed.
    for found in (own, imported):
        for name, text in sorted((_name(file), code.text) for file, code in found.items()):
            digest.update(f"{name}\n{text}\n".encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class _Code:
    """What counts of a file: its text, and the files of ours that it imports itself."""

    text: str
    imports: frozenset[Path]


@cache
def _code_of(file: Path, names: frozenset[str] | None = None) -> _Code:
    """What counts of a file; with names, of what is needed for these alone."""
    body = _Stripped().visit(ast.parse(file.read_bytes())).body
    if names is not None:
        body = _needed(body, set(names))
    used = _used(body)
    # What a package gives away is used by others.
    gives = names is None and file.name == "__init__.py"
    texts, imports = [], set()
    for node in (node for statement in body for node in ast.walk(statement)):
        match node:
            case ast.Import():
                imports |= {alias.name for alias in node.names}
            case ast.ImportFrom(module=str(module), level=0):
                for alias in node.names:
                    if gives or (alias.asname or alias.name) in used:
                        # What a package gives is a module of it, or stands in its own file.
                        one = f"{module}.{alias.name}"
                        imports.add(one if _file_of(one) else module)
                        texts.append(f"{one} as {alias.asname}")
    texts += [
        ast.dump(statement)
        for statement in body
        if not isinstance(statement, ast.Import | ast.ImportFrom)
    ]
    files = {found for name in imports if (found := _file_of(name)) is not None}
    return _Code("\n".join(texts), frozenset(files))


class _Stripped(ast.NodeTransformer):
    """Takes away docstrings and annotations; those of the fields of a class stay."""

    in_class = False

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        return self._inside(node, in_class=True)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self._inside(node, in_class=False)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        node.annotation = None
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST | None:
        if self.in_class:
            return self.generic_visit(node)
        if node.value is None:
            return None
        plain = ast.copy_location(ast.Assign([node.target], node.value), node)
        return self.generic_visit(plain)

    def _inside(self, node: ast.AST, *, in_class: bool) -> ast.AST:
        outer, self.in_class = self.in_class, in_class
        node = self.generic_visit(node)
        self.in_class = outer
        return node


def _needed(body: Iterable[ast.stmt], names: set[str]) -> list[ast.stmt]:
    """The statements of a module that define names, or what these use, or nothing by name."""
    left, found = list(body), []
    while more := [one for one in left if not (bound := _bound(one)) or bound & names]:
        found += more
        left = [one for one in left if one not in more]
        names = names | _used(more)
    return sorted(found, key=lambda statement: statement.lineno)


def _bound(statement: ast.stmt) -> set[str]:
    """The names that a statement of a module defines."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    bound = set()
    for node in ast.walk(statement):
        match node:
            case ast.Name(id=name, ctx=ast.Store()):
                bound.add(name)
            case ast.alias():
                bound.add((node.asname or node.name).split(".")[0])
            case ast.FunctionDef() | ast.ClassDef():
                bound.add(node.name)
    return bound


def _used(statements: Iterable[ast.stmt]) -> set[str]:
    nodes = (node for statement in statements for node in ast.walk(statement))
    return {node.id for node in nodes if isinstance(node, ast.Name)}


def _name(file: Path) -> str:
    for root in _ROOTS.values():
        if file.is_relative_to(root):
            return file.relative_to(root.parent).as_posix()
    return file.name


@cache
def _file_of(name: str) -> Path | None:
    """The file of a module of ours."""
    first, *rest = name.split(".")
    if first not in _ROOTS:
        return None
    place = _ROOTS[first].joinpath(*rest)
    candidates = (place.with_suffix(".py"), place / "__init__.py")
    return next((file for file in candidates if file.is_file()), None)

"""Drake's own ways of writing a system, as mkdocstrings reads them.

A system for several scalar types is a class inside a function that `template` decorates,
and its ports stand in a directive of Drake's documentation.  Read as plain Python, the first is
an assignment without a docstring, and the second is text.
"""

import ast
import re
from typing import Any

import griffe
import yaml

DIRECTIVE = ".. pydrake_system::"
# One that is meant; not those before the name of an argument that is described.
ASTERISK = re.compile(r"\*(?!\*?\w+:)")


class DrakeDocstrings(griffe.Extension):
    """Reads template systems as classes, and port diagrams as tables."""

    def on_module_node(self, *, node: ast.AST | griffe.ObjectNode, **_: Any) -> None:
        """Puts the class of a template in place of `Name = Name_[None]`."""
        if not isinstance(node, ast.Module):
            return
        for position, statement in enumerate(node.body):
            if isinstance(statement, ast.FunctionDef) and _is_template(statement):
                template, name = statement.name, statement.name.removesuffix("_")
                node.body[position] = _documented(template, name, statement.lineno)
                for other, candidate in enumerate(node.body):
                    if ast.unparse(candidate) == f"{name} = {template}[None]":
                        node.body[other] = _system_class(statement, name)

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Makes Markdown of a docstring: its port diagram, and asterisks that are meant."""
        if obj.docstring is not None:
            text = _with_port_table(obj.docstring.value)
            obj.docstring.value = "`".join(
                ASTERISK.sub(r"\\*", part) if number % 2 == 0 else part
                for number, part in enumerate(text.split("`"))
            )


def _is_template(function: ast.FunctionDef) -> bool:
    return any(ast.unparse(d) == "template" for d in function.decorator_list)


def _documented(template: str, name: str, line: int) -> ast.stmt:
    """Returns the template as a name; its docstring is that of what stands after it."""
    docstring = f"The template of `{name}` over its scalar type, float or AutoDiffXd."
    statement = ast.parse(f"class {template}:\n    {docstring!r}").body[0]
    for part in ast.walk(statement):
        if isinstance(part, ast.stmt | ast.expr):
            part.lineno = part.end_lineno = line
    return statement


def _system_class(function: ast.FunctionDef, name: str) -> ast.ClassDef:
    """Returns the class inside a template, its constructor as users call it."""
    system = next(part for part in function.body if isinstance(part, ast.ClassDef))
    system.name = name
    system.bases = [ast.Name("LeafSystem", ast.Load())]
    for method in system.body:
        if isinstance(method, ast.FunctionDef) and method.name == "_construct":
            method.name = "__init__"
    return system


def _with_port_table(text: str) -> str:
    """Returns a docstring with its port diagram as a table."""
    before, directive, rest = text.partition(DIRECTIVE)
    if not directive:
        return text
    lines = rest.splitlines()[1:]
    end = next(
        (number for number, line in enumerate(lines) if line and line[0] != " "), len(lines)
    )
    system = yaml.safe_load("\n".join(lines[:end]))
    inputs, outputs = (
        "<br>".join(f"`{port}`" for port in system.get(kind, ())) or "none"
        for kind in ("input_ports", "output_ports")
    )
    table = f"| input ports | output ports |\n|---|---|\n| {inputs} | {outputs} |\n\n"
    return before + table + "\n".join(lines[end:])

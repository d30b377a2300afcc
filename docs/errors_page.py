"""The page of errors: exit codes, and every message that the code raises, read from its source."""

import ast
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from curate.errors import CurateError

_PACKAGES = ("curate", "db", "pipelines")
_INTRODUCTION = """\
A command that fails prints one line on standard error: what is wrong, where, and what to do. Its
exit code shows the class of the error. An unknown option or a missing argument has exit code 2 too.
Errors of the operating system, such as a full disk or a missing permission, have exit code 1.

Work that is finished when an error occurs is kept. Fix the cause and run the same command again.
"""


@dataclass(frozen=True, order=True)
class Message:
    """A message of the code: its text with <names> for what varies, and the file that raises it."""

    text: str
    source: str


def errors_page(root: Path, note: str) -> str:
    """Return the page: the exit codes, then the messages of each class."""
    kinds = error_classes()
    messages = messages_of(root, {kind.__name__ for kind in kinds})
    parts = ["# Errors", note, _INTRODUCTION, "## Exit codes", ""]
    parts += ["| code | class | meaning |", "|---|---|---|", "| 0 | | success |"]
    parts += [f"| {kind.exit_code} | `{kind.__name__}` | {_meaning(kind)} |" for kind in kinds]
    parts += ["| 130 | | interrupted with Ctrl-C; the same command resumes |", ""]
    parts += [
        "In Python, all of them are subclasses of `curate.errors.CurateError`.",
        "",
        "## Messages",
        "",
        "Parts in angle brackets vary. Search for the constant part of the line that you see.",
        "",
    ]
    for kind in kinds:
        found = sorted(messages.get(kind.__name__, ()))
        parts += [f"### {kind.__name__}", "", f"Exit code {kind.exit_code}: {_meaning(kind)}", ""]
        if found:
            parts += ["| message | raised in |", "|---|---|"]
            parts += [f"| {as_code(one.text)} | `{one.source}` |" for one in found]
            parts.append("")
    return "\n".join(parts)


def error_classes() -> list[type[CurateError]]:
    """Return the root and all of its subclasses, by exit code and name.

    Their order of definition depends on what was imported first.
    """
    found = [CurateError]
    for kind in found:
        found += kind.__subclasses__()
    return sorted(found, key=lambda kind: (kind.exit_code, kind is not found[0], kind.__name__))


def messages_of(root: Path, classes: set[str]) -> dict[str, set[Message]]:
    """Return the messages with which the code constructs errors of some classes."""
    messages: dict[str, set[Message]] = {name: set() for name in classes}
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            source = path.relative_to(root).as_posix()
            for name, text in _raised(ast.parse(path.read_text()), classes):
                if re.search(r"\w", re.sub(r"<[^>]*>", "", text)):
                    messages[name].add(Message(text, source))
    return messages


def _raised(module: ast.Module, classes: set[str]) -> Iterator[tuple[str, str]]:
    """Yield (class, text) of every error that a module constructs."""
    for scope in ast.walk(module):
        if not isinstance(scope, (ast.FunctionDef, ast.Module)):
            continue
        nodes = [node for child in scope.body for node in _within(child)]
        values = {
            node.targets[0].id: node.value
            for node in nodes
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
        }
        for node in nodes:
            if isinstance(node, ast.Call) and node.args:
                name = _last_name(node.func)
                if name in classes:
                    yield from ((name, text) for text in _texts(node.args[0], values))


def _within(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and what is below it, without functions inside it."""
    if isinstance(node, ast.FunctionDef):
        return
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _within(child)


def _texts(node: ast.expr, values: dict[str, ast.expr]) -> list[str]:
    """Return the texts that an expression can give, with <names> for what varies."""
    match node:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.JoinedStr(values=parts):
            texts = [""]
            for part in parts:
                inner = part.value if isinstance(part, ast.FormattedValue) else part
                ends = _texts(inner, {}) if isinstance(inner, ast.Constant) else [_hole(inner)]
                texts = [text + end for text in texts for end in ends]
            return texts
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            ends = _texts(right, values)
            return [text + end for text in _texts(left, values) for end in ends]
        case ast.IfExp(body=body, orelse=orelse):
            return [*_texts(body, values), *_texts(orelse, values)]
        case ast.Name(id=name) if name in values:
            others = {key: value for key, value in values.items() if key != name}
            return _texts(values[name], others)
        case _:
            return [_hole(node)]


def _hole(node: ast.AST) -> str:
    """Return the name of what varies: the variable or attribute that is shown."""
    return f"<{_last_name(node) or 'text'}>"


def _last_name(node: ast.AST) -> str:
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
        case ast.Call(func=ast.Attribute(attr="join"), args=[value, *_]):
            return _last_name(value)
        case ast.Call(func=func, args=arguments):
            return _last_name([*arguments, func][0])
        case ast.Subscript(value=value) | ast.BinOp(left=value) | ast.IfExp(body=value):
            return _last_name(value)
        case ast.GeneratorExp(generators=[one, *_]) | ast.ListComp(generators=[one, *_]):
            return _last_name(one.iter)
        case _:
            return ""


def _meaning(kind: type[CurateError]) -> str:
    if kind is CurateError:
        return "Any other error."
    return " ".join((inspect.getdoc(kind) or "").split())


def as_code(text: str) -> str:
    """Return a message as code in a cell of a table."""
    text = " ".join(text.split()).replace("|", "\\|")
    return f"`` {text} ``" if "`" in text else f"`{text}`"

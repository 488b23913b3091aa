"""Docstrings as reStructuredText: prose as it stands, `code` in single backticks, indented blocks literal."""

import inspect
import re
from typing import Any


class Raw:
    """An annotation that is shown as its text."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def signature_of(thing: Any, method: bool = False) -> str:
    """Return the signature of a class or function as it is written, "()" if it has none."""
    try:
        told = inspect.signature(thing)
    except (TypeError, ValueError):
        return "()"
    plain = [_plain(each) for each in told.parameters.values()]
    returned = told.return_annotation
    told = told.replace(
        parameters=plain[1:] if method and plain and plain[0].name in ("self", "cls") else plain,
        return_annotation=Raw(returned) if isinstance(returned, str) else returned,
    )
    return plain_names(str(told)).replace(" -> None", "")


def plain_names(code: str) -> str:
    """Return code in which types have no module before them."""
    return re.sub(r"typing\.|kalmark\.(\w+\.)+", "", code)


def _plain(one: inspect.Parameter) -> inspect.Parameter:
    note, default = getattr(one.annotation, "__forward_arg__", one.annotation), one.default
    if default is not one.empty and not isinstance(default, int | float | str | bool | tuple | None):
        default = Raw("...")
    return one.replace(annotation=Raw(note) if isinstance(note, str) else note, default=default)


def rst(text: str) -> str:
    """Return a docstring as reStructuredText."""
    out: list[str] = []
    for block in re.split(r"\n\s*\n", text.strip("\n")):
        if block.startswith(">>>"):
            out.append(block)
        elif re.match(r" {2,}\S", block):
            literal = "\n".join("    " + line for line in inspect.cleandoc(block).splitlines())
            out += [literal] if out and out[-1].startswith(("::", "    ")) else ["::", literal]
        else:
            out.append(_inline(block))
    return "\n\n".join(out)


def _inline(block: str) -> str:
    rows = []
    for line in block.splitlines():
        bullet, said = re.match(r"((?:\* +)?)(.*)", line.strip()).groups()  # type: ignore[union-attr]
        rows.append((bullet or ("  " if rows and rows[0].startswith("* ") else "")) + _words(said))
    return "\n".join(rows)


def _words(line: str) -> str:
    parts = line.replace("``", "`").split("`")
    plain = [_prose(part) for part in parts[::2]]
    code = [f"``{part}``" if part else "" for part in parts[1::2]]
    return "".join(a + b for a, b in zip(plain, [*code, ""], strict=False)) if len(parts) % 2 else _prose(line)


def _prose(text: str) -> str:
    text = re.sub(r"([\\*|_`])", r"\\\1", text)
    return re.sub(r"docs/((?:\w|\\_)+)\.md", lambda m: f":doc:`/{m[1].replace(chr(92), '')}`", text)

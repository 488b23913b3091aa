"""CONTRIBUTING.md and CHANGELOG.md as pages of the site, in project/, and links to programs as they are shown."""

import re
from pathlib import Path
from typing import Any

FILES = {"CONTRIBUTING.md": "project/contributing.md", "CHANGELOG.md": "project/changelog.md"}


def write(app: Any) -> None:
    """Write the pages where git ignores them."""
    docs = Path(app.srcdir)
    for name, page in FILES.items():
        text = re.sub(r"\]\((?!https?:|#)(?:docs/)?", "](../", (docs.parent / name).read_text())
        (docs / page).parent.mkdir(exist_ok=True)
        if not (docs / page).exists() or (docs / page).read_text() != text:
            (docs / page).write_text(text)


def link(app: Any, name: str, source: list[str]) -> None:
    """Point the pages to these instead of the files above them, and to the page of a program; show titles of pages."""
    for file, page in FILES.items():
        source[0] = source[0].replace(f"](../{file}", f"]({page}")
    source[0] = re.sub(r"(?<=: )docs/(\w+\.md)", r"[\1](\1)", source[0])  # of a docstring
    source[0] = re.sub(r"\[\w+\.md\](?=\([\w./]+\.md)", "[]", source[0])  # MyST shows the title of an empty link
    source[0] = source[0].replace("](course/items.csv)", "](lessons/items.md)")
    source[0] = re.sub(r"\]\(course/(\w+)/\)", r"](lessons/\1/index.rst)", source[0])
    for programs, shown in (("tutorials", "how"), ("course", "lessons")):
        source[0] = re.sub(rf"\]\((\.\./)?{programs}/([\w/]+)\.py\)", rf"](\1{shown}/\2.rst)", source[0])


def setup(app: Any) -> dict[str, bool]:
    """Connect both."""
    app.connect("builder-inited", write)
    app.connect("source-read", link)
    return {"parallel_read_safe": True}

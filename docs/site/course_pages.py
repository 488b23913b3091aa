"""The pages of the seeds in lessons/: every item with its state and place, and every figure beside ours.

Items are the rows of course/items.csv and of the tables in toolbox.md.
"""

import csv
import re
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import api_pages

SEEDS = {"S": "The guide [S]", "T": "The exercises [T]", "F": "The slides [F]", "TB": "The toolbox [TB]"}
STATES = ("works", "partly", "missing")
PICTURES = {"S": range(1, 10), "T": range(1, 5), "F": (), "TB": (1, 2, 14, 16)}  # the toolbox's others are listings
SEARCH = """
```{raw} html
<p><input id="items-search" type="search" placeholder="Search: an equation, a word, missing, ..." size="40"
  aria-label="Search the table"> <span id="items-count"></span></p>
<script>
addEventListener("DOMContentLoaded", () => {
  const box = document.getElementById("items-search"), count = document.getElementById("items-count");
  const rows = [...document.querySelectorAll(".bd-article section section tbody tr")];
  const within = (text, number) => [...text.matchAll(/\\((\\d+)\\)-\\((\\d+)\\)/g)].some(
    ([, first, last]) => first <= number && number <= last);
  const has = (text, word) => text.includes(word) || (/^\\(\\d+\\)$/.test(word) && within(text, +word.slice(1, -1)));
  const show = () => {
    const words = box.value.toLowerCase().split(/\\s+/);
    for (const row of rows) row.hidden = !words.every((word) => has(row.textContent.toLowerCase(), word));
    for (const part of document.querySelectorAll(".bd-article section section"))
      part.hidden = !part.querySelector("tbody tr:not([hidden])");
    count.textContent = `${rows.filter((row) => !row.hidden).length} of ${rows.length} rows`;
  };
  box.addEventListener("input", show);
  show();
});
</script>
```
"""


class Item(NamedTuple):
    """One thing that a reader of a seed may ask for.

    `page` is a lesson CHAPTER/plot_NAME, a tutorial how/plot_NAME, a page api/NAME of the reference, or PAGE.md with
    or without #anchor.  `names` are names in Python and commands.
    """

    seed: str
    chapter: str
    place: str
    item: str
    state: str
    page: str
    names: tuple[str, ...]
    note: str

    @property
    def numbers(self) -> dict[str, set[int]]:
        """The numbers of the equations, figures and tables of this item."""
        found: dict[str, set[int]] = {"equation": set(), "Figure": set(), "Table": set()}
        for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", self.place):
            found["equation"] |= set(range(int(first), int(last or first) + 1))
        for kind, first, last in re.findall(r"(Figure|Table)s? (\d+)(?: and (\d+))?", self.place):
            found[kind] |= {int(first), int(last or first)}
        return found


def items(docs: Path) -> list[Item]:
    """Return all items: those of the table, then the options of the toolbox."""
    with (docs / "course" / "items.csv").open(newline="") as file:
        rows = [Item._make([*row[:6], tuple(filter(None, row[6].split("; "))), row[7]]) for row in csv.reader(file)]
    return [*rows[1:], *options((docs / "toolbox.md").read_text())]


def options(text: str) -> list[Item]:
    """Return the items of the toolbox's user data: the rows of its page."""
    found = []
    for head, body in re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", text, re.M | re.S):
        page = "toolbox.md#" + re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-")
        for line in body.splitlines():
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            if len(cells) > 1 and cells[0] not in ("toolbox", "-") and not cells[0].startswith("---"):
                state = {"not available": "missing", "not done": "missing", "partly": "partly"}
                shown = next((s for start, s in state.items() if cells[1].startswith(start)), "works")
                why = "" if shown == "works" else f": {cells[2]}"
                found.append(Item("TB", f"Settings: {head}", cells[0], cells[1] + why, shown, page, (), ""))
    return found


def write(app: Any) -> None:
    """Write both pages, if they differ."""
    docs = Path(app.srcdir)
    all_items, pages = items(docs), api_pages.pages()
    for name, text in (("items", table(all_items, pages)), ("figures", pictures(all_items, docs / "lessons"))):
        file = docs / "lessons" / f"{name}.md"
        file.parent.mkdir(exist_ok=True)
        if not file.exists() or file.read_text() != text:
            file.write_text(text)


def table(all_items: list[Item], pages: dict[str, str]) -> str:
    """Return the page of all items, by seed and chapter."""
    out = [
        "# Every item of the four documents\n",
        "Each section, equation, figure, table, program, exercise, slide and option of the",
        "[four documents](../learn.md), with its state here. *works*: kalmark does it, and the page shows it.",
        "*partly*: a part of it, or no page shows it. *missing*: kalmark does not have it; the row has the reason.",
        "A page of their own has the [figures of the documents](figures.md), drawn by kalmark.\n",
        "| document | " + " | ".join(STATES) + " | items |\n|---|---|---|---|---|",
    ]
    for seed, title in [*SEEDS.items(), ("", "all")]:
        counted = Counter(each.state for each in all_items if seed in ("", each.seed))
        out.append(f"| {title} | " + " | ".join(str(counted[s]) for s in STATES) + f" | {counted.total()} |")
    out.append(SEARCH)
    for seed, title in SEEDS.items():
        out.append(f"## {title}\n")
        of_seed = [each for each in all_items if each.seed == seed]
        for chapter in dict.fromkeys(each.chapter for each in of_seed):
            out.append(f"### {chapter}\n\n| place | item | state | page | in kalmark |\n|---|---|---|---|---|")
            for each in (one for one in of_seed if one.chapter == chapter):
                told = re.sub(r"\]\((?!https?:)", "](../", ". ".join(filter(None, [each.item, each.note])))
                names = ", ".join(linked(name, pages) for name in each.names)
                page = f"[]({target(each.page)})" if each.page else ""
                out.append(f"| {each.place} | {told} | {each.state} | {page} | {names} |")
            out.append("")
    return "\n".join(out)


def pictures(all_items: list[Item], lessons: Path) -> str:
    """Return the page of the figures that lessons draw again.

    A lesson of several figures draws one each; of others it is the last picture, which is complete.
    """
    out = [
        "# Figures of the four documents\n",
        "Each figure by its number, as a lesson draws it from what it computes; slides have no numbers.\n",
    ]
    for seed in PICTURES:
        out += [f"## {SEEDS[seed]}\n", "::::{grid} 1 2 2 3\n:gutter: 3\n"]
        shown = drawn_items(all_items, seed)
        for title, each in shown:
            folder, name = each.page.split("/")
            drawn = sorted(path.name for path in (lessons / folder / "images").glob(f"sphx_glr_{name}_00?.png"))
            alike = [other for _, other in shown if other.page == each.page]
            picture = (
                drawn[alike.index(each) if len(alike) == len(drawn) else -1] if drawn else f"sphx_glr_{name}_001.png"
            )
            out.append(f":::{{grid-item-card}} {title}\n:link: {each.page}\n:link-type: doc")
            out.append(f":img-bottom: {folder}/images/{picture}\n\n{each.item}\n:::\n")
        out.append("::::\n")
    return "\n".join(out)


def drawn_items(all_items: list[Item], seed: str) -> list[tuple[str, Item]]:
    """Return titles and items that lessons draw of a seed: figures by their numbers, of the slides one each lesson."""
    mine = [each for each in all_items if each.seed == seed and "/plot_" in each.page]
    if not PICTURES[seed]:
        lessons = {each.page: each for each in reversed(mine) if each.page.startswith("slides/")}
        return [(lessons[page].place, lessons[page]) for page in sorted(lessons)]
    return [
        (f"Figure {number}", next(each for each in mine if number in each.numbers["Figure"]))
        for number in PICTURES[seed]
    ]


def target(page: str) -> str:
    """Return the link to a page from lessons/."""
    if "/plot_" in page:
        return f"{'../' if page.startswith('how/') else ''}{page}.rst"
    return f"../{page}.rst" if page.startswith("api/") else f"../{page}"


def linked(name: str, pages: dict[str, str]) -> str:
    """Return a name with the link to its page of the reference, if it has one."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        page = pages.get(".".join(parts[:k]))
        if page and name.startswith("k"):
            return f"[`{name}`](../api/{page}.rst)"
    return f"`{name}`"


def frame(app: Any, doctree: Any) -> None:
    """Put each figure of a lesson into a box of its own, which scrolls on a narrow page."""
    nodes = import_module("docutils.nodes")  # the tests of the table need no Sphinx
    for image in list(doctree.findall(lambda node: type(node).__name__ == "imgsgnode")):
        image.replace_self(nodes.container("", image.deepcopy(), classes=["figure-of-lesson"]))


def setup(app: Any) -> dict[str, bool]:
    """Write the pages before Sphinx reads them."""
    app.connect("builder-inited", write)
    app.connect("doctree-read", frame)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    states = Counter(each.state for each in items(Path(__file__).parents[1]))
    print("items:", ", ".join(f"{states[state]} {state}" for state in STATES))

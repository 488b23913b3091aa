"""`kalmark bag`: what is in a ROS bag, and a configuration to start from."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import print_table, say
from kalmark.errors import LogError

if TYPE_CHECKING:
    from kalmark.bags.survey import TopicSummary


def bag(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A ROS bag: .bag, .mcap, .db3, or its folder.")],
    out: Annotated[
        Path | None, typer.Option(metavar="CONFIG", help="Write a first configuration that maps its topics.")
    ] = None,
    definition: Annotated[
        list[str] | None,
        typer.Option(metavar="TYPE=FILE", help="The .msg file of a type that the bag does not define."),
    ] = None,
) -> None:
    """List the topics of a ROS bag, their rates, gaps and frames; write a first configuration that maps them."""
    from kalmark.bags.bag_opening import EXPECTED, find_bag
    from kalmark.bags.first_config import first_config
    from kalmark.bags.survey import survey
    from kalmark.files import write
    from kalmark.logs import find_data

    if out is not None and out.exists():
        raise LogError(f"--out {out}: this file exists already, expected a new one")
    path = find_bag(find_data(file))
    if path is None:
        raise LogError(f"{file}: not a bag, {EXPECTED}")
    given = dict(each.partition("=")[::2] for each in definition or ())
    if not all(name.endswith(".msg") for name in given.values()):
        raise LogError(
            f"--definition {' '.join(definition or ())}: expected TYPE=FILE, such as uwb_msgs/Range=Range.msg"
        )
    found = survey(path, {kind: str(Path(name).resolve()) for kind, name in given.items()})
    columns = ("topic", "type", "messages", "rate (Hz)", "gaps", "longest (s)", "at (s)", "frames", "read as")
    rows = [_row(topic) for topic in found.topics]
    print_table(f"{path.name}: {found.length_s:.1f} s", columns, rows, align="<<>>>>><<")
    still = sorted(f"{child} in {parent}" for parent, child in found.frames.first.keys() - found.frames.moving)
    moving = sorted(f"{child} in {parent}" for parent, child in found.frames.moving)
    for what, pairs in (("frames that move", moving), ("frames that stand still", still)):
        if pairs:
            say(f"{what}: {', '.join(pairs)}")
    if out is not None:
        write(out, first_config(found, out))
        say(f"{out}: look at the lines with GUESS, then kalmark run {shlex.quote(str(out))}")


def _row(topic: TopicSummary) -> tuple[str, ...]:
    """Return a topic as a row of the table."""
    rate, longest = (f"{v:.3g}" if math.isfinite(v) else "-" for v in (topic.rate_hz, topic.longest_s))
    at = f"{topic.longest_at_s:.1f}" if topic.gaps else "-"
    kind = topic.type.replace("/msg/", "/")
    return (
        topic.name,
        kind,
        str(topic.count),
        rate,
        str(topic.gaps),
        longest,
        at,
        topic.frames,
        topic.error or topic.what or "-",
    )

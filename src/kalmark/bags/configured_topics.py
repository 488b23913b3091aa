"""The topics of a bag that a configuration names, checked against their types."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from kalmark.bags.bag_opening import UNDEFINED, Bag, Received
from kalmark.bags.fields import leaves, offers
from kalmark.bags.messages import MESSAGES, Message, Seen
from kalmark.bags.topics import Carried, Compass, Imu, Posed, Topic
from kalmark.errors import LogError
from kalmark.logs.log import Names

beams_of: Callable[..., Seen] | None = MESSAGES["sensor_msgs/msg/LaserScan"].seen


def content_of_topic(bag: Bag, name: str, topic: Topic) -> Message:
    """Return the contents of the messages of a topic.  Raises LogError if they do not fit its section."""
    kind = bag.topics[name].type
    known = offers(kind, bag.definitions, f"log option topics: {name}", topic)
    if known is None or not any(getattr(known, want) for want in topic.needs):
        if known is None and kind not in bag.definitions:
            raise LogError(f"{bag.path}: topic {name} has messages of the type {short(kind)}, {UNDEFINED}")
        types = ", ".join(sorted({short(k) for k, m in MESSAGES.items() if any(getattr(m, w) for w in topic.needs)}))
        what = short(kind) if known is None else f"{short(kind)} ({known.what})"
        own = ", ".join(path for path, _ in leaves(kind, bag.definitions)) if known is None else ""
        own = f", or `fields` of {own}" if own else ""
        raise LogError(f"{bag.path}: topic {name} has messages of the type {what}, expected one of {types}{own}")
    if known.transforms is not None and not (isinstance(topic, Posed) and topic.frame and topic.child_frame):
        raise LogError(f"{bag.path}: topic {name} has many frames, expected `frame` and `child_frame`: two of them")
    return known


def short(kind: str) -> str:
    """Return a type's name as users write it."""
    return kind.replace("/msg/", "/")


def sensor_name(name: str, scan: Carried) -> str:
    """Return the name of a topic's sensor."""
    return scan.sensors(name)[0]


class Asked:
    """The topics that are asked for, by the names of their entries, and what their messages offer.

    `named` are the topics themselves, `columns` those of each robot's controls.  Raises LogError.
    """

    def __init__(self, bag: Bag, topics: Mapping[str, Topic]) -> None:
        self.bag = bag
        self.topics = {name if topic.topic else bag.find(name): topic for name, topic in topics.items()}
        self.named = {name: bag.find(topic.topic) if topic.topic else name for name, topic in self.topics.items()}
        self.offers = {name: content_of_topic(bag, self.named[name], topic) for name, topic in self.topics.items()}
        self.columns = self._controls()
        for name, topic in self.topics.items():
            self._refuse_other_world(name, topic)

    def entries(self, received: Received) -> list[str]:
        """Return the entries of the configuration that a message's topic has."""
        return [name for name, topic in self.named.items() if topic == received.topic]

    def _controls(self) -> dict[str, Names]:
        """Return the columns of each robot's controls.  Raises LogError if two topics are those of one robot."""
        columns: dict[str, Names] = {}
        named: dict[str, str] = {}
        for name, topic in self.topics.items():
            if topic.columns and topic.robot in columns:
                raise LogError(
                    f"{self.bag.path}: topics {named[topic.robot]} and {name} are both controls of {topic.robot!r}, "
                    "expected one topic of controls for each robot"
                )
            if topic.columns:
                columns[topic.robot], named[topic.robot] = topic.columns, name
        return columns

    def _refuse_other_world(self, name: str, topic: Topic) -> None:
        """Refuse readings that robots of the plane, or of space, do not have.  Raises LogError."""
        space = self.in_space(topic.robot)
        if isinstance(topic, Compass) and space:
            what, wanted = "headings by a magnetic field", "one of the plane"
        elif isinstance(topic, Imu) and (topic.inclination or topic.gravity) and not space:
            what, wanted = "inclinations or gravity", "one of space"
        else:
            return
        raise LogError(f"{self.bag.path}: topic {name} gives {what} to {topic.robot!r}, expected {wanted}")

    def in_space(self, robot: str) -> bool:
        """Return whether a robot moves in space: by its controls; one without any does if it has no laser scanner."""
        mine = {name: topic for name, topic in self.topics.items() if topic.robot == robot}
        own = [topic.space for topic in mine.values() if topic.columns]
        return own[0] if own else not any(self.offers[name].seen is beams_of for name in mine)

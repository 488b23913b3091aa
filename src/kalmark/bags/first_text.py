"""The text of a first configuration: YAML on one line, and a topic in words."""

from __future__ import annotations

import math

from kalmark.bags.configured_topics import short
from kalmark.bags.survey import TopicSummary
from kalmark.logs.log import Section

GUESS = "GUESS:"
Entry = tuple[Section, str]
"""The entry of a topic in a configuration, and the reason for it."""


def yaml_text(text: str) -> str:
    """Return a text as YAML has it."""
    plain = text and text[0].isalpha() | (text[0] in "/_") and all(c.isalnum() or c in "/_-." for c in text)
    return text if plain and text not in ("true", "false", "null", "yes", "no", "on", "off") else f"'{text}'"


def yaml_mapping(values: Section) -> str:
    """Return a mapping on one line of YAML."""
    parts = []
    for key, value in values.items():
        if isinstance(value, dict):
            text = yaml_mapping(value)
        elif isinstance(value, list | tuple):
            text = f"[{', '.join(v if isinstance(v, str) else repr(float(v)) for v in value)}]"
        elif value is None:
            text = "null"
        else:
            words = yaml_text(value) if isinstance(value, str) else str(value)
            text = f"{value:.6g}" if isinstance(value, float) else words
        parts.append(f"{key}: {text}")
    return f"{{{', '.join(parts)}}}"


def topic_text(topic: TopicSummary) -> str:
    """Return a topic in words."""
    rate = f", {topic.rate_hz:.3g} Hz" if math.isfinite(topic.rate_hz) else ""
    frames = f", {topic.frames}" if topic.frames else ""
    return f"{topic.count} {short(topic.type).split('/')[-1]}{rate}{frames}"

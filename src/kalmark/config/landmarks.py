"""Configuration of landmark types and of association: which landmark was that, and what is one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Tag

from kalmark.config.sections import Gate, Probability, Section, type_or


class PointLandmark(Section):
    """A Euclidean point: (x, y) in the plane, (x, y, z) in space."""

    type: Literal["point"] = "point"


class PointSignatureLandmark(Section):
    """A Euclidean point of the plane with a signature (x, y, s)."""

    type: Literal["point_signature"] = "point_signature"


Landmark = Annotated[
    Annotated[PointLandmark, Tag("point")] | Annotated[PointSignatureLandmark, Tag("point_signature")],
    Discriminator(type_or("point")),
]


class IdentityAssociation(Section):
    """Trust the ids of the log."""

    type: Literal["identity"] = "identity"
    gate: Gate = "default"
    """Refuse observations outside this probability; or off, or default."""


class NearestAssociation(Section):
    """The nearest landmark by Mahalanobis distance, inside its gate."""

    type: Literal["nearest"] = "nearest"
    gate: Probability = 0.99
    """Pair an observation with a landmark inside this probability."""
    new_gate: Probability = 0.99999
    """Beyond this probability from every landmark it is a new one; in between it is left alone."""


Association = Annotated[
    Annotated[IdentityAssociation, Tag("identity")] | Annotated[NearestAssociation, Tag("nearest")],
    Discriminator(type_or("identity")),
]

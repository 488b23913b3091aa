"""Configuration of landmark types and of association: which landmark was that, and what is one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from kalmark.config.sections import Gate, NotNegative, Number, Probability, Section, type_or


class PointLandmark(Section):
    """A Euclidean point: (x, y) in the plane, (x, y, z) in space."""

    type: Literal["point"] = "point"


class PointSignatureLandmark(Section):
    """A Euclidean point of the plane with a signature (x, y, s)."""

    type: Literal["point_signature"] = "point_signature"


class PolarLandmark(Section):
    """A point of the plane by anchor, direction and distance (4 numbers), for ranges with poor bearings."""

    type: Literal["polar"] = "polar"


class _Depth(Section):
    prior_rho_per_m: Number = 0.01
    """Inverse distance expected where the sensor sees none."""
    sigma_rho_per_m: NotNegative = 0.5
    """Standard deviation of that."""


class InverseDepthLandmark(Section):
    """A point by anchor, direction and inverse distance: 4 numbers in the plane, 6 in space.

    The nearest landmark at d m is in the prior if prior_rho_per_m + 2 sigma_rho_per_m is 1 / d.
    """

    type: Literal["inverse_depth"] = "inverse_depth"
    prior_rho_per_m: Number | None = None
    """Inverse distance expected where the sensor sees none; if absent 0.5 in the plane, 0.01 in space."""
    sigma_rho_per_m: NotNegative | None = None
    """Standard deviation of that; if absent 0.25 in the plane, 0.5 in space."""


class AnchoredHomogeneousLandmark(_Depth):
    """A point of space by anchor, ray and inverse distance (7 numbers)."""

    type: Literal["anchored_homogeneous"] = "anchored_homogeneous"


class HomogeneousLandmark(_Depth):
    """A homogeneous point of space (4 numbers)."""

    type: Literal["homogeneous"] = "homogeneous"


class TagLandmark(Section):
    """A square tag: its pose."""

    type: Literal["tag"] = "tag"


class _Line(Section):
    extend: bool = True
    """The segment kept beside the line grows with what is seen of it."""
    switch_px: NotNegative = 10.0
    """Pluecker kinds: a segment whose ends are less certain than this follows the measured one instead."""


class _Direction(_Line):
    prior_beta_1: Number = 0.1
    """Direction expected in the plane of sight, which one image does not tell: first component."""
    prior_beta_2: Number = 0.0
    """Second component."""
    sigma_beta_1: NotNegative = 0.25
    """Standard deviation of the first component."""
    sigma_beta_2: NotNegative = 1.0
    """Standard deviation of the second component."""


class PlueckerLineLandmark(_Direction):
    """A line by moment and direction (6 numbers)."""

    type: Literal["pluecker_line"] = "pluecker_line"


class AnchoredPlueckerLineLandmark(_Direction):
    """A line by anchor, moment about it and direction (9 numbers)."""

    type: Literal["anchored_pluecker_line"] = "anchored_pluecker_line"


class _Depths(_Line):
    prior_rho_per_m: Number = 0.1
    """Inverse distance expected of both ends."""
    sigma_rho_per_m: NotNegative = 0.5
    """Standard deviation of each."""


class InverseDepthLineLandmark(_Depths):
    """A line by anchor and azimuth, elevation and inverse distance of two points (9 numbers)."""

    type: Literal["inverse_depth_line"] = "inverse_depth_line"


class AnchoredHomogeneousLineLandmark(_Depths):
    """A line by anchor and ray and inverse distance of two points (11 numbers)."""

    type: Literal["anchored_homogeneous_line"] = "anchored_homogeneous_line"


class HomogeneousLineLandmark(_Depths):
    """A line by two homogeneous points (8 numbers)."""

    type: Literal["homogeneous_line"] = "homogeneous_line"


Landmark = Annotated[
    Annotated[PointLandmark, Tag("point")]
    | Annotated[PointSignatureLandmark, Tag("point_signature")]
    | Annotated[PolarLandmark, Tag("polar")]
    | Annotated[InverseDepthLandmark, Tag("inverse_depth")]
    | Annotated[AnchoredHomogeneousLandmark, Tag("anchored_homogeneous")]
    | Annotated[HomogeneousLandmark, Tag("homogeneous")]
    | Annotated[TagLandmark, Tag("tag")]
    | Annotated[PlueckerLineLandmark, Tag("pluecker_line")]
    | Annotated[AnchoredPlueckerLineLandmark, Tag("anchored_pluecker_line")]
    | Annotated[InverseDepthLineLandmark, Tag("inverse_depth_line")]
    | Annotated[AnchoredHomogeneousLineLandmark, Tag("anchored_homogeneous_line")]
    | Annotated[HomogeneousLineLandmark, Tag("homogeneous_line")],
    Discriminator(type_or("point")),
]


class IdentityAssociation(Section):
    """Trust the ids of the log."""

    type: Literal["identity"] = "identity"
    gate: Gate = "default"
    """Refuse observations outside this probability; or off, or default."""


class _GatedAssociation(Section):
    gate: Probability = 0.99
    """Pair an observation with a landmark inside this probability."""
    new_gate: Probability = 0.99999
    """Beyond this probability from every landmark it is a new one; in between it is left alone."""


class NearestAssociation(_GatedAssociation):
    """The nearest landmark by Mahalanobis distance, inside its gate."""

    type: Literal["nearest"] = "nearest"


class GlobalAssociation(_GatedAssociation):
    """The pairs of the whole scan whose squared Mahalanobis distances add up to the least."""

    type: Literal["global"] = "global"


class JointAssociation(_GatedAssociation):
    """The largest set of pairs that fit together (JCBB): for a pose known worse than landmarks are apart."""

    type: Literal["jcbb"] = "jcbb"
    most_nodes: Annotated[int, Field(ge=1)] = 20_000
    """Nodes of the search after which the best so far is taken."""


class _SearchedAssociation(_GatedAssociation):
    most_nodes: Annotated[int, Field(ge=1)] = 5_000_000
    """Comparisons of pairs after which the search ends."""


class CliqueAssociation(_SearchedAssociation):
    """The largest set of pairs that agree with each other wherever the robot is, if it fits jointly."""

    type: Literal["clique"] = "clique"


class SampleAssociation(_SearchedAssociation):
    """A matching drawn by how likely each is."""

    type: Literal["sample"] = "sample"
    seed: Annotated[int, Field(ge=0)] = 0
    """Another one draws others."""


class AveragedAssociation(_SearchedAssociation):
    """The mean over all matchings, each by how likely it is; for a dense map."""

    type: Literal["jpda"] = "jpda"


class AutomaticAssociation(_SearchedAssociation):
    """One by one where the pose is clear, the likeliest matching where it is not; what is ambiguous is deferred."""

    type: Literal["auto"] = "auto"
    confidence: Annotated[float, Field(ge=0, lt=1)] = 0.9
    """A pair of the likeliest matching that is less probable is deferred."""


Association = Annotated[
    Annotated[IdentityAssociation, Tag("identity")]
    | Annotated[NearestAssociation, Tag("nearest")]
    | Annotated[GlobalAssociation, Tag("global")]
    | Annotated[JointAssociation, Tag("jcbb")]
    | Annotated[CliqueAssociation, Tag("clique")]
    | Annotated[SampleAssociation, Tag("sample")]
    | Annotated[AveragedAssociation, Tag("jpda")]
    | Annotated[AutomaticAssociation, Tag("auto")],
    Discriminator(type_or("identity")),
]


class TrilaterationConfig(Section):
    """Keep ranges with where they were taken until a position follows: docs/range_only.md."""

    type: Literal["trilateration"] = "trilateration"
    poses: Annotated[int, Field(ge=4)] = 24
    """Ranges kept of one landmark; of more, every other one is given up."""
    directions: Annotated[int, Field(ge=3)] = 12
    """Directions in which the search for the position starts."""
    odds: Probability = 1e-3
    """A second position with better odds than this means to wait."""


class HypothesesConfig(Section):
    """Start hypotheses of the direction at the first range, and weigh them: docs/range_only.md."""

    type: Literal["hypotheses"] = "hypotheses"
    count: Annotated[int, Field(ge=3)] = 12
    """Hypotheses of the direction."""
    odds: Probability = 1e-3
    """A hypothesis is removed when its share of the weights falls below this."""

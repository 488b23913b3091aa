"""Data association: the landmark of each observation, by the log's ids, by nearest neighbours, together, or jointly.

The queries and decisions of an association are in `protocol`; a user's own one requires `Association` only.
"""

from __future__ import annotations

from kalmark.association.gated import ByIdentity, GlobalAssignment, JointCompatibility, NearestNeighbour
from kalmark.association.protocol import DEFERRED, NEW, REMAP, Answer, Association, Decision
from kalmark.association.query import Query
from kalmark.association.weighing import Automatic, Averaged, Cliques, Sampled

__all__ = [
    "DEFERRED", "NEW", "REMAP", "Answer", "Association", "Automatic", "Averaged", "ByIdentity", "Cliques", "Decision",
    "GlobalAssignment", "JointCompatibility", "NearestNeighbour", "Query", "Sampled",
]  # fmt: skip

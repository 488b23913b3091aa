"""Ways to start landmarks late: from bearings, or from ranges by trilateration or by hypotheses."""

from kalmark.management.delayed import Delayed
from kalmark.management.hypotheses import Hypotheses
from kalmark.management.pending import Initialization
from kalmark.management.trilateration import Trilateration

__all__ = ["Delayed", "Hypotheses", "Initialization", "Trilateration"]

r"""
Your own estimator
==================

An estimator predicts and corrects the map, [S] (14)-(30). The simplest ones change what another one is given.
"""

# %%
# More noise than the sensors state
# ---------------------------------
#
# ``update`` has the scan: observation model, slots of the landmarks, measurements ``y`` and their noise ``R``.
from typing import Annotated, ClassVar

import matplotlib.pyplot as plt

import kalmark as km
from kalmark.config import build_slam
from kalmark.declare import Positive
from kalmark.simulate import load_world, simulate


@km.register("estimator", "with_more_noise")
class WithMoreNoise:
    """The textbook filter, with more noise than the sensors state."""

    factor: Annotated[Positive, "Of the covariance of the noise."] = 2.0
    coordinates: ClassVar = "world"
    default_gate: ClassVar = 9.0

    def predict(self, map_, movement):
        return km.estimators.Ekf().predict(map_, movement)

    def correct(self, map_, update):
        return km.estimators.Ekf().correct(map_, update._replace(R=self.factor * update.R))

    def for_fixes(self):
        return self

    def pose_jacobian(self, map_, robot, J):
        return J


# %%
# Compare it
# ----------
#
# The same simulated log by four estimators. ``Textbook`` is the guide's program, ``Ekf`` its faster form. In a
# configuration: ``estimator: {type: with_more_noise, factor: 4}``.
# The NEES of a consistent filter is 3 on average over many runs (``kalmark campaign``); too much noise makes it
# small.
world = load_world("random_field", ["steps=150"])
log = simulate(world, seed=2)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained", sharey=True)
for estimator in (km.estimators.Invariant(), km.estimators.Ekf(), km.textbook.Textbook(), WithMoreNoise(factor=4.0)):
    run = km.record(build_slam(world.config(), log, estimator=estimator), log, progress=False)
    told = run.evaluate()
    print(f"{type(estimator).__name__:14} pose NEES {told['robots']['rover']['pose_nees']:.2f}", end=", ")
    print(f"NIS per degree of freedom {told['nis_per_dof']:.2f}")
    left.barh(type(estimator).__name__, told["robots"]["rover"]["pose_nees"])
    right.barh(type(estimator).__name__, told["nis_per_dof"])
left.axvline(3, color="0.4")
left.set(xlabel="pose NEES, 3 expected")
right.axvline(1, color="0.4")
right.set(xlabel="NIS per degree of freedom, 1 expected")
plt.show()

# %%
# Try changing
# ------------
#
# ``factor=0.2``: the stated noise is too small, NIS and NEES grow.
#
# Another equation: copy the file of ``km.textbook``, change a line of ``TextbookSlam``, and name the class of the copy,
# ``estimator: mine:Textbook`` with ``plugins: [mine.py]`` (docs/textbook.md).

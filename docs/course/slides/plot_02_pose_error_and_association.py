r"""
[F] An error of the pose moves a whole scan
===========================================

The second reason: it is unknown which observation is of which landmark, and an error of the pose moves all observations
of a scan in the same way. Wrong pairs come together; their errors are correlated. With a heading that is wrong by
:math:`\delta`, an observation at the range :math:`d` moves by about :math:`d\,\delta`.
"""

# %%
# Pairs with the nearest landmark
# -------------------------------
#
# A robot at the origin observes landmarks on a grid without noise. Its estimated heading is wrong by ``delta``. Each
# observation is placed, [S] (31), and paired with the nearest landmark.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

spacing, delta = 2.0, 0.15
landmarks = spacing * np.array([[i, j] for i in range(1, 8) for j in range(-4, 5)])
ys = km.geometry.observe([0, 0, 0], landmarks)[0]


def paired(heading):
    """Return the places of the observations (K, 2) and the landmarks (K,) nearest to them."""
    places = km.geometry.inv_observe([0, 0, heading], ys)[0]
    return places, np.linalg.norm(places[:, None] - landmarks, axis=2).argmin(axis=1)


print(
    "wrong pairs:", {each: int((paired(each)[1] != range(len(ys))).sum()) for each in (0.05, delta, 0.3)}, "of", len(ys)
)


# %%
# Wrong together
# --------------
#
# Red are the wrong pairs: those far away. Right: the share of wrong pairs against
# the error of the heading, near and far.
places, nearest = paired(delta)
figure, (ax, share) = plt.subplots(1, 2, figsize=(10, 4.8), layout="constrained")
for place, i, j in zip(places, range(len(places)), nearest, strict=True):
    ax.plot(*np.transpose([place, landmarks[j]]), "tab:green" if i == j else "tab:red")
ax.plot(*landmarks.T, "k+", label="landmarks")
ax.plot(*places.T, ".", color="tab:blue", label="observations")
ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=f"heading wrong by {delta} rad")
ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncol=2)
deltas = np.linspace(0, 0.3, 31)
wrong = np.array([paired(each)[1] != np.arange(len(ys)) for each in deltas])
for low, high in ((0, 6), (6, 12), (12, 18)):
    chosen = (ys[:, 0] >= low) & (ys[:, 0] < high)
    share.plot(deltas, wrong[:, chosen].mean(axis=1), label=f"{low} m to {high} m")
share.set(xlabel="error of the heading [rad]", ylabel="share of wrong pairs")
share.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * ``spacing, delta = 2.0, 0.05``: all pairs are green.
# * ``spacing, delta = 4.0, 0.15``: as many are wrong as before. The ranges grow with the spacing; only the angle
#   between neighbours counts.
# * An error of the position: ``km.geometry.inv_observe([0.9, 0, 0], ys)``. No pair is wrong. With 1.5 m, more than
#   half of the spacing, most are, at all distances alike.

"""The functions of the SLAM toolbox ([TB]), recorded: values and Jacobians agree, or there is a reason why not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kalmark.errors import ModelError
from kalmark.models import cameras
from toolbox import Array, arrays, k_of, recorded
from toolbox_functions import COUNTERPARTS
from toolbox_lines import LINE_COUNTERPARTS

ANOTHER_WAY = "kalmark never writes a landmark in another frame: it is seen from a frame, or made from a view, directly"
WITHOUT: dict[str, str] = {
    "constVel_jac_tustin": "a first-order quaternion, not normalised; ours turns exactly, as constVel_nojac_exact",
    "w2omega": "a part of that first-order integration",
    "q2Pi": "a part of that first-order integration",
    "invDistortion": "of a fixed number of coefficients, fitted to a smaller circle: a test below compares round trips",
    "fromFrameIdp": ANOTHER_WAY,
    "toFrameIdp": ANOTHER_WAY,
    "fromFrameAhm": ANOTHER_WAY,
    "fromFrameAPlucker": ANOTHER_WAY,
}
PARTLY: dict[str, str] = {
    "constVel_nojac_exact": "recorded without Jacobians",
    "R2q": "recorded without Jacobians",
    "q2v": "where w < 0 the toolbox takes the longer way round: value only, brought to the shorter",
    "normvec_exact": "kalmark's quaternions stay unit: value only; of directions (3 numbers) see directions.unit_many",
    "normvec_scalar": "the recorded Jacobian is I / |v|, not exact",
    "invPinHole": "P_k, P_c: kalmark does not start landmarks from an uncertain calibration",
    "invPinHole_noc": "P_k likewise",
    "omniCam": "U_k, U_pol: kalmark does not calibrate this camera",
    "invOmniCam": "P_k likewise; the recorded P_u is of the scalar normalisation: compared after (I - m m')",
    "retroProjIdpPntFromPinHoleOnRob": "L_k, L_c as in invPinHole",
    "retroProjAhmPntFromPinHoleOnRob": "likewise; the recorded L_u is of the scalar normalisation: after (I - m m')",
    "retroProjHmgPntFromPinHoleOnRob": "likewise; the recorded L_u is of the scalar normalisation: after (I - m m')",
    "ahp2idp": "the toolbox keeps rho, kalmark rho / |m|: the point stays where it is",
    "p2idp": "the recorded rho is 1 / |m|^2, a defect, and so are its Jacobians",
    "fromFrameHmg": "L_l in the direction: kalmark's ray is made a unit vector first",
    "toFrameHmg": "rho does not change: the last row is not a view",
    "innovation_pnt": "z, Z and its inverse are parts of the filter; the distance is compared",
    "hms2hh": "Z_s is made of the expected line's normal; kalmark's noise is across the measured segment",
    "innovation_lin": "the inverse of Z is a part of the filter; the distance is compared",
    "projPlkLinIntoPinHoleOnRob": "the image line, normalised; HM_k: lines do not calibrate; v: no part of a view",
    "projAplLinIntoPinHoleOnRob": "likewise",
    "retroProjPlkLinFromPinHoleOnRob": "L_k as in invPinHole; L_hm in the pixels of a segment on the line",
    "retroProjAplLinFromPinHoleOnRob": "likewise",
    "retroProjIdpLinFromPinHoleOnRob": "L_k as in invPinHole",
    "retroProjHmgLinFromPinHoleOnRob": "likewise; the recorded L_seg is of the scalar normalisation: after (I - m m')",
    "retroProjAhmLinFromPinHoleOnRob": "likewise; of the second end only that in u is recorded, in the place of v",
    "toFramePlucker": "the direction is no part of a view: the first three rows",
    "fromFramePlucker": "likewise",
    "anchorPlucker": "the rows of the new normal: the others are copies",
    "visibleSegment": "where nothing is seen the toolbox says 0, kalmark NaN or what is too short",
    "trimHmgLin": "the toolbox's ends come in another order",
    "cov2elli": "the contour may start elsewhere: every point is compared with the ellipse",
}


BOTH = COUNTERPARTS | LINE_COUNTERPARTS


@pytest.mark.parametrize("name", BOTH)
def test_the_toolboxs_function_agrees(name: str, oracle: Callable[[str], Path]) -> None:
    cases = recorded(oracle("functions.json.gz"))[name]
    assert cases
    for case in cases:
        for at, pair in enumerate(BOTH[name](arrays(case["in"]), arrays(case["out"]))):
            ours, theirs = map(np.asarray, pair)
            assert ours.shape == theirs.shape, f"output {at}"
            scale = max(1.0, float(abs(theirs).max(initial=0)))
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * scale, err_msg=f"output {at}")


def test_every_recorded_function_has_a_counterpart_or_a_reason_for_none(oracle: Callable[[str], Path]) -> None:
    assert not BOTH.keys() & WITHOUT.keys()
    assert BOTH.keys() | WITHOUT.keys() == recorded(oracle("functions.json.gz")).keys()
    assert PARTLY.keys() <= BOTH.keys()


def round_trip(d: Array, k: Array, c: Array) -> float:
    """Return the largest error in pixels over an image of 640 x 480."""
    y = np.stack([a.ravel() for a in np.meshgrid(np.linspace(0, 640, 41), np.linspace(0, 480, 31))], axis=1)
    rays, _ = cameras.back_project_pinhole(y, k, c)
    return float(np.hypot(*(cameras.project_pinhole(rays, k, d)[0] - y).T).max())


def test_the_fitted_correction_gives_pixels_back_better_than_the_recorded_one(oracle: Callable[[str], Path]) -> None:
    refused = 0
    for case in recorded(oracle("functions.json.gz"))["invDistortion"]:
        d, k, c = arrays(case["in"])["d"], k_of(arrays(case["in"])["k"]), arrays(case["out"])["c"]
        if d.tolist() == [-0.2, 0.05, -0.01]:  # folds the image at its corners, or almost: the recorded c is of no use
            with pytest.raises(ModelError):
                cameras.fit_correction(d, k, (640, 480))
            refused += 1
            continue
        assert round_trip(d, k, cameras.fit_correction(d, k, (640, 480))) < 0.01 < round_trip(d, k, c)
    assert refused == 2

"""The textbook filters against batch least squares and against each other."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km

Q, R = np.diag([0.1, 0.05]) ** 2, np.diag([0.1, 0.02]) ** 2


def test_the_kalman_filter_ends_where_least_squares_over_all_states_does() -> None:
    rng = np.random.default_rng(1)
    n, m, steps = 3, 2, 6
    D, M, y = rng.normal(size=(n, n)), rng.normal(size=(m, n)), rng.normal(size=(steps, m))
    Sigma_d, Sigma_m, Sigma_0 = np.diag([0.3, 0.1, 0.2]), np.diag([0.5, 0.2]), np.diag([1.0, 2.0, 3.0])
    kf = km.textbook.KalmanFilter(D, M, Sigma_d, Sigma_m, x=[1.0, -1.0, 2.0], Sigma=Sigma_0)
    kf.correct(y[0])
    for each in y[1:]:
        kf.predict()
        kf.correct(each)

    information, vector = np.zeros((steps * n, steps * n)), np.zeros(steps * n)
    information[:n, :n] = np.linalg.inv(Sigma_0)
    vector[:n] = np.linalg.solve(Sigma_0, [1.0, -1.0, 2.0])
    for k in range(steps):
        at = slice(k * n, (k + 1) * n)
        information[at, at] += M.T @ np.linalg.solve(Sigma_m, M)
        vector[at] += M.T @ np.linalg.solve(Sigma_m, y[k])
        if k:
            A = np.hstack([-D, np.eye(n)])
            both = slice((k - 1) * n, (k + 1) * n)
            information[both, both] += A.T @ np.linalg.solve(Sigma_d, A)
    np.testing.assert_allclose(kf.x, np.linalg.solve(information, vector)[-n:], atol=1e-10)
    np.testing.assert_allclose(kf.Sigma, np.linalg.inv(information)[-n:, -n:], atol=1e-10)


def numeric_move(x: np.ndarray, n: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.concatenate([km.geometry.move(x[:3], u, n)[0], x[3:]])


def analytic_move(x: np.ndarray, n: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, ...]:
    r, R_r, R_n = km.geometry.move(x[:3], u, n)
    F_x, F_n = np.eye(len(x)), np.zeros((len(x), 2))
    F_x[:3, :3], F_n[:3] = R_r, R_n
    return np.concatenate([r, x[3:]]), F_x, F_n


def observation(x: np.ndarray, n: np.ndarray, i: int) -> np.ndarray:
    return np.asarray(km.geometry.observe(x[:3], x[3 + 2 * i : 5 + 2 * i])[0] + n)


def landmark(x: np.ndarray, n: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(km.geometry.inv_observe(x[:3], y + n)[0])


@pytest.mark.parametrize("f", [numeric_move, analytic_move])
def test_the_extended_filter_with_a_map_as_its_state_is_the_guides_ekf_slam(f: object) -> None:
    rng, start = np.random.default_rng(2), np.diag([0.1, 0.1, 0.05]) ** 2
    ekf = km.textbook.ExtendedKalmanFilter(f, observation, Q, R, x=[0, 0, 3.1], Sigma=start, angles=[2], angles_y=[1])
    book = km.textbook.TextbookSlam(start=[0, 0, 3.1], Q=Q, R=R, P=start)
    for y in ([3.0, 0.6], [4.0, -0.3]):
        ekf.augment(landmark, R, np.array(y))
        book.initialize(y)
    for _ in range(20):
        u = np.array([0.3, 0.2]) + rng.multivariate_normal(np.zeros(2), Q)
        ekf.predict(u)
        book.predict(u)
        for i in range(2):
            y = book.expect(i)[0] + rng.multivariate_normal(np.zeros(2), R)
            ekf.correct(y, i)
            assert book.correct(i, y, gate=np.inf)
    np.testing.assert_allclose(ekf.x, book.x, atol=1e-7)
    np.testing.assert_allclose(ekf.Sigma, book.P, atol=1e-8)


def test_differences_of_an_angle_do_not_jump_by_a_turn() -> None:
    ekf = km.textbook.ExtendedKalmanFilter(
        numeric_move, observation, Q, R, x=[0, 0, np.pi, -3, 0], Sigma=np.diag([0.1, 0.1, 0.05, 1, 1]),
        angles=[2], angles_y=[1],
    )  # fmt: skip
    book = km.textbook.TextbookSlam(start=[0, 0, np.pi], Q=Q, R=R)
    book.x, book.P = ekf.x.copy(), ekf.Sigma.copy()
    ekf.predict(np.zeros(2))
    book.predict(np.zeros(2))
    np.testing.assert_allclose(ekf.Sigma, book.P, atol=1e-8)


def test_stacked_and_sequential_corrections_agree_where_the_measurement_is_linear() -> None:
    M = np.array([[1.0, 0.5], [0.0, 1.0], [2.0, -1.0]])
    kind = dict(f=lambda x, n: x + n, g=lambda x, n, k: M[k] @ x + n, Sigma_n=np.eye(2), Sigma_m=[[0.3]])
    one, all_ = (km.textbook.ExtendedKalmanFilter(**kind, x=[1, 2], Sigma=np.diag([1, 3])) for _ in range(2))
    ys = [[1.2], [0.7], [-0.4]]
    for k, y in enumerate(ys):
        one.correct(y, k)
    all_.correct_stacked(ys, [(0,), (1,), (2,)])
    np.testing.assert_allclose(all_.x, one.x, atol=1e-9)
    np.testing.assert_allclose(all_.Sigma, one.Sigma, atol=1e-9)


def test_noise_inside_a_measurement_counts_by_its_jacobian() -> None:
    ekf = km.textbook.ExtendedKalmanFilter(
        f=lambda x, n: x, g=lambda x, n: x * (1 + n), Sigma_n=[[0.0]], Sigma_m=[[0.01]], x=[10.0], Sigma=[[1.0]]
    )
    ekf.correct([11.0])  # sigma of y is 10 * 0.1 = 1: both weigh the same
    np.testing.assert_allclose([ekf.x[0], ekf.Sigma[0, 0]], [10.5, 0.5], atol=1e-8)


def test_each_equation_is_printed_if_asked(capsys: pytest.CaptureFixture[str]) -> None:
    kf = km.textbook.KalmanFilter([[1.0]], [[1.0]], [[1.0]], [[2.0]], x=[0.0], Sigma=[[1.0]], show=True)
    kf.predict()
    kf.correct([3.0])
    book = km.textbook.TextbookSlam(start=[0, 0, 0], Q=Q, R=R, show=True)
    book.correct(book.initialize([3.0, 0.6]), [3.1, 0.6])
    out = capsys.readouterr().out
    assert "Sigma- =\n[[2.]]" in out and "K =\n[[0.5]]" in out and "x+ =\n[1.5]" in out and "Z (20) =" in out


def test_a_matrix_of_another_shape_is_refused() -> None:
    with pytest.raises(km.KalmarkError, match=r"M: an array \(1, 1\), expected \(1, 2\)"):
        km.textbook.KalmanFilter(np.eye(2), [[1.0]], np.eye(2), [[1.0]], x=[0, 0], Sigma=np.eye(2))

# SPDX-License-Identifier: Apache-2.0
"""Filters of other libraries behind one interface, each used according to its manual.

A library is imported when its first filter is created. All use the same prior and noise variance; filters without
covariance get a hand-chosen learning rate, and features scaled to the order of 1.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from research.peers.hand_filters import GATE, START, START_SD, VARIANCE, Item, RowPeer, speeds_of
from research.peers.metro_stream import BEFORE, INERTIA, PERIOD, SPEED_SD, MetroStream

Floats = NDArray[np.float64]
DRIFT: Final = 4e-5
"""Drift of a, b, c per update, relative to their values."""
_TRUTH: Final = np.array((BEFORE.a, BEFORE.b, BEFORE.c))
_SCALE: Final = np.array((1.0, 1.0 / 15.0, 1.0 / 225.0))
# White noise per tick equivalent to gusts of 0.1 N/kN with 10 s correlation time (1 N/kN), and force noise [N/kN].
_FORCE_SD: Final = 1.05


def drift_covariance(share: float) -> Floats:
    """Return the process noise covariance of a, b, c per update, shape (3, 3)."""
    return np.diag((share * _TRUTH) ** 2)


def unscaled(weights: Any) -> Floats:
    """Return a, b, c of weights for features of order 1."""
    theta: Floats = np.asarray(weights, dtype=np.float64) * _SCALE
    return theta


class PadasipRls(RowPeer):
    """padasip FilterRLS without forgetting."""

    def __init__(self) -> None:
        self._filter = import_module('padasip').filters.FilterRLS(3, mu=1.0, eps=1e-3, w=np.array(START))

    def step(self, y: float, phi: Floats) -> None:
        self._filter.adapt(y, phi)

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._filter.w, VARIANCE * np.asarray(self._filter.R)


class PadasipGmcc(RowPeer):
    """padasip FilterGMCC: gradient steps that decrease for large errors."""

    def __init__(self) -> None:
        start = np.array(START) / _SCALE
        self._filter = import_module('padasip').filters.FilterGMCC(3, mu=0.01, lambd=0.03, alpha=2, w=start)

    def step(self, y: float, phi: Floats) -> None:
        self._filter.adapt(y, phi * _SCALE)

    @property
    def moments(self) -> tuple[Any, Any]:
        return unscaled(self._filter.w), None


class RiverBayes(RowPeer):
    """river BayesianLinearRegression."""

    def __init__(self) -> None:
        model = import_module('river.linear_model').BayesianLinearRegression
        self._model = model(alpha=1.0, beta=1.0 / VARIANCE)

    def items(self, stream: MetroStream) -> list[Item]:
        return [(y, {'a': 1.0, 'b': v, 'c': v * v}) for y, v in speeds_of(stream)]

    def step(self, y: float, phi: Any) -> None:
        self._model.learn_one(phi, y)

    @property
    def moments(self) -> tuple[Any, Any]:
        parts = ({'a': 1.0, 'b': 0.0, 'c': 0.0}, {'a': 0.0, 'b': 1.0, 'c': 0.0}, {'a': 0.0, 'b': 0.0, 'c': 1.0})
        return [self._model.predict_one(part) for part in parts], None


class RiverHuber(RowPeer):
    """river LinearRegression by stochastic gradient with Huber's loss."""

    def __init__(self) -> None:
        optim = import_module('river.optim')
        model = import_module('river.linear_model').LinearRegression
        rate = 0.002
        self._model = model(optimizer=optim.SGD(rate), loss=optim.losses.Huber(1.5), intercept_lr=rate)

    def items(self, stream: MetroStream) -> list[Item]:
        return [(y, {'b': v * _SCALE[1], 'c': v * v * _SCALE[2]}) for y, v in speeds_of(stream)]

    def step(self, y: float, phi: Any) -> None:
        self._model.learn_one(phi, y)

    @property
    def moments(self) -> tuple[Any, Any]:
        weights = self._model.weights
        return unscaled((self._model.intercept, weights.get('b', 0.0), weights.get('c', 0.0))), None


class SklearnHuber(RowPeer):
    """scikit-learn SGDRegressor with Huber's loss, row by row."""

    def __init__(self) -> None:
        regressor = import_module('sklearn.linear_model').SGDRegressor
        settings: dict[str, Any] = {'loss': 'huber', 'epsilon': 1.5, 'penalty': None, 'fit_intercept': False}
        self._model = regressor(learning_rate='constant', eta0=0.002, random_state=0, **settings)

    def items(self, stream: MetroStream) -> list[Item]:
        return [(np.array([y]), (phi * _SCALE)[np.newaxis]) for y, phi in super().items(stream)]

    def step(self, y: Any, phi: Floats) -> None:
        self._model.partial_fit(phi, y)

    @property
    def moments(self) -> tuple[Any, Any]:
        return unscaled(self._model.coef_), None


class FilterpyKalman(RowPeer):
    """filterpy KalmanFilter with drift, optionally with a gate before the update."""

    def __init__(self, gate: float = 0.0, drift: float = DRIFT, factor: float = 1.0) -> None:
        self._filter = filterpy_kalman(drift, factor)
        self._limit = gate * gate

    def step(self, y: float, phi: Floats) -> None:
        kf = self._filter
        kf.predict()
        H = phi[np.newaxis]
        if self._limit:
            e = y - float(phi @ kf.x[:, 0])
            if e * e > self._limit * (VARIANCE + float(phi @ kf.P @ phi)):
                return
        kf.update(y, H=H)

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._filter.x, self._filter.P


def filterpy_kalman(drift: float, factor: float) -> Any:
    """Return a filterpy KalmanFilter of a, b, c whose noise has ``factor`` times the variance of a clean row."""
    kf = import_module('filterpy.kalman').KalmanFilter(dim_x=3, dim_z=1)
    kf.x = np.array(START)[:, np.newaxis]
    kf.P = np.diag(np.square(START_SD))
    kf.Q = drift_covariance(drift)
    kf.R = np.array([[VARIANCE * factor]])
    return kf


class FilterpyImm(RowPeer):
    """filterpy IMMEstimator of two filters, for clean rows and for rows with 400 times the variance."""

    def __init__(self) -> None:
        filters = [filterpy_kalman(DRIFT, factor) for factor in (1.0, 400.0)]
        change = np.array(((0.97, 0.03), (0.3, 0.7)))
        self._imm = import_module('filterpy.kalman').IMMEstimator(filters, np.array((0.9, 0.1)), change)

    def step(self, y: float, phi: Floats) -> None:
        for kf in self._imm.filters:
            kf.H = phi[np.newaxis]
        self._imm.predict()
        self._imm.update(np.array([[y]]))

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._imm.x, self._imm.P


class SimdKalman(RowPeer):
    """simdkalman.primitives, predict and update."""

    def __init__(self) -> None:
        self._primitives = import_module('simdkalman.primitives')
        self._m, self._P = np.array(START), np.diag(np.square(START_SD))
        self._A, self._Q, self._R = np.eye(3), drift_covariance(DRIFT), np.array([[VARIANCE]])

    def step(self, y: float, phi: Floats) -> None:
        m, P = self._primitives.predict(self._m, self._P, self._A, self._Q)
        self._m, self._P = self._primitives.update(m, P, phi[np.newaxis], self._R, np.array([y]))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the module, which cannot be pickled."""
        return {name: value for name, value in self.__dict__.items() if name != '_primitives'}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state and import the module again."""
        self.__dict__.update(state, _primitives=import_module('simdkalman.primitives'))

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._m, self._P


class PyKalman(RowPeer):
    """pykalman KalmanFilter.filter_update."""

    def __init__(self) -> None:
        self._m, self._P = np.array(START), np.diag(np.square(START_SD))
        settings = {'transition_matrices': np.eye(3), 'transition_covariance': drift_covariance(DRIFT)}
        kalman = import_module('pykalman').KalmanFilter
        self._filter = kalman(observation_covariance=np.array([[VARIANCE]]), n_dim_obs=1, n_dim_state=3, **settings)

    def step(self, y: float, phi: Floats) -> None:
        self._m, self._P = self._filter.filter_update(self._m, self._P, y, observation_matrix=phi[np.newaxis])

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._m, self._P


class StoneSoupKalman(RowPeer):
    """Stone Soup KalmanPredictor and KalmanUpdater."""

    def __init__(self) -> None:
        linear = import_module('stonesoup.models.transition.linear')
        self._measurement = import_module('stonesoup.models.measurement.linear').LinearGaussian
        self._detection = import_module('stonesoup.types.detection').Detection
        self._hypothesis = import_module('stonesoup.types.hypothesis').SingleHypothesis
        model = linear.LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=np.eye(3), covariance_matrix=drift_covariance(DRIFT)
        )
        self._predictor = import_module('stonesoup.predictor.kalman').KalmanPredictor(model)
        self._updater = import_module('stonesoup.updater.kalman').KalmanUpdater(None)
        self._time = datetime(2026, 1, 1, tzinfo=UTC)
        state = import_module('stonesoup.types.state').GaussianState
        self._state = state(np.array(START)[:, np.newaxis], np.diag(np.square(START_SD)), timestamp=self._time)

    def step(self, y: float, phi: Floats) -> None:
        self._time += timedelta(seconds=PERIOD)
        model = self._measurement(3, (0,), np.array([[VARIANCE]]))
        # The model measures single states; its matrix is replaced by the row.
        model.matrix = lambda **_: phi[np.newaxis]
        detection = self._detection(np.array([[y]]), timestamp=self._time, measurement_model=model)
        predicted = self._predictor.predict(self._state, timestamp=self._time)
        self._state = self._updater.update(self._hypothesis(predicted, detection))

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._state.mean, self._state.covar


class RawPeer(RowPeer):
    """A filter of [v, a, b, c] from raw ticks; ``step(seen, force, moving)`` processes one tick."""

    def items(self, stream: MetroStream) -> list[Item]:
        raw = stream.raw
        force = (raw.force - raw.gradient).tolist()
        return list(zip(raw.speed.tolist(), force, raw.moving.tolist(), strict=True))

    def __init__(self, drift: float = DRIFT) -> None:
        self._P0 = np.diag(np.square((SPEED_SD, *START_SD)))
        self._Q = np.zeros((4, 4))
        self._Q[0, 0] = (_FORCE_SD * PERIOD / INERTIA) ** 2
        self._Q[1:, 1:] = drift_covariance(drift)
        self._was_moving = False

    def departs(self, seen: float, moving: bool, x: Floats, P: Floats) -> bool:
        """Reset the speed to the measurement at departure; return True if the tick needs no prediction and update."""
        starts = moving and not self._was_moving
        self._was_moving = moving
        if starts:
            x[0] = seen
            P[0, :] = P[:, 0] = 0.0
            P[0, 0] = SPEED_SD**2
        return starts or not moving


def next_state(x: Floats, dt: float, force: float) -> Floats:
    """Return [v, a, b, c], shape (4,) or (4, 1), after a tick under a specific force less the gradient [N/kN]."""
    v = x[0]
    new = x.copy()
    new[0] = v + dt / INERTIA * (force - x[1] - v * (x[2] + v * x[3]))
    return new


def seen_speed(x: Floats) -> Floats:
    """Return the measured part of the state, the speed [m/s]."""
    return x[:1]


class FilterpyEkf(RawPeer):
    """filterpy ExtendedKalmanFilter with a gate before the update."""

    def __init__(self, drift: float = DRIFT) -> None:
        super().__init__(drift)
        self._filter = import_module('filterpy.kalman').ExtendedKalmanFilter(dim_x=4, dim_z=1)
        self._filter.x = np.array((0.0, *START))[:, np.newaxis]
        self._filter.P = self._P0.copy()
        self._filter.Q = self._Q
        self._filter.R = np.array([[SPEED_SD**2]])

    def step(self, seen: float, force: float, moving: bool) -> None:
        ekf = self._filter
        if self.departs(seen, moving, ekf.x, ekf.P):
            return
        gain, v = PERIOD / INERTIA, float(ekf.x[0, 0])
        ekf.F = np.eye(4)
        ekf.F[0] = 1.0 - gain * float(ekf.x[2, 0] + 2.0 * v * ekf.x[3, 0]), -gain, -gain * v, -gain * v * v
        ekf.x = next_state(ekf.x, PERIOD, force)
        ekf.P = ekf.F @ ekf.P @ ekf.F.T + ekf.Q
        e = seen - float(ekf.x[0, 0])
        if e * e <= GATE**2 * (float(ekf.P[0, 0]) + SPEED_SD**2):
            ekf.update(np.array([[seen]]), speed_jacobian, seen_speed)

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._filter.x, self._filter.P


def speed_jacobian(x: Floats) -> Floats:
    """Return the derivative of the measured speed, shape (1, 4)."""
    del x
    return np.array([[1.0, 0.0, 0.0, 0.0]])


class FilterpyUkf(RawPeer):
    """filterpy UnscentedKalmanFilter, no gate."""

    def __init__(self) -> None:
        super().__init__()
        kalman = import_module('filterpy.kalman')
        points = kalman.MerweScaledSigmaPoints(4, alpha=0.1, beta=2.0, kappa=-1.0)
        self._filter = kalman.UnscentedKalmanFilter(4, 1, PERIOD, hx=seen_speed, fx=next_state, points=points)
        self._filter.x = np.array((0.0, *START))
        self._filter.P = self._P0.copy()
        self._filter.Q = self._Q
        self._filter.R = np.array([[SPEED_SD**2]])

    def step(self, seen: float, force: float, moving: bool) -> None:
        if not self.departs(seen, moving, self._filter.x, self._filter.P):
            self._filter.predict(force=force)
            self._filter.update(np.array([seen]))

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._filter.x, self._filter.P

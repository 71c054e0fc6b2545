# SPDX-License-Identifier: Apache-2.0
"""The printed model in closed form compared with the matrix exponential, and its equilibrium."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from trainid_lab.brake_rate.pade_model import pade_model
from trainid_ros.interface.errors import InputError


@pytest.mark.parametrize(('dt', 'tau', 'lam'), [(1.0, 0.4, 1.6667), (0.2, 0.63, 2.9), (0.05, 1.5, 0.4)])
@pytest.mark.parametrize('f', [0.0, 0.73, 1.1])
def test_the_closed_form_is_the_exact_discretisation_of_the_printed_matrices(
    dt: float, tau: float, lam: float, f: float
) -> None:
    A = np.zeros((5, 5))
    A[0, 1] = A[1, 2] = 1.0
    A[2, 2:5] = -1.0 / tau, f / tau, -f / tau
    A[3, 3:5] = -lam, 2.0 * lam
    exact = expm(A * dt)
    model = pade_model(dt, tau, lam)
    assert np.max(np.abs(model.Phi0 + f * model.Phi1 - exact[:4, :4])) < 1e-13
    assert np.max(np.abs(model.Gamma0 + f * model.Gamma1 - exact[:4, 4])) < 1e-13


def test_the_printed_initial_state_is_the_equilibrium_for_a_command_of_minus_one() -> None:
    model = pade_model(1.0, 0.4, 1.6667)
    x = (model.Phi0 + model.Phi1) @ [0.0, 20.0, -1.0, -2.0] - (model.Gamma0 + model.Gamma1)
    assert x == pytest.approx([19.5, 19.0, -1.0, -2.0])
    step = model.step(-2.0, -1.0, 0.05)
    assert step.predict(np.array([[0.0], [20.0], [-1.0]]), np.ones(1))[:, 0] == pytest.approx([19.5, 19.0, -1.0])
    assert model.next_a_z(-2.0, -1.0) == pytest.approx(-2.0)


def test_a_pole_of_the_closed_form_is_rejected() -> None:
    with pytest.raises(InputError, match='lam tau must not be 1'):
        pade_model(1.0, 0.5, 2.0)

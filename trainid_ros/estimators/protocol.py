# SPDX-License-Identifier: Apache-2.0
"""Interface of every estimator for its drivers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from trainid_ros.results import Rejection
    from trainid_ros.stream.samples import Sample

EstimateT_co = TypeVar('EstimateT_co', covariant=True)


class Estimator(Protocol[EstimateT_co]):
    """A streaming estimator: explicit state, one step per sample, an estimate when asked for."""

    def step(self, sample: Sample) -> Rejection | None:
        """Take in one sample; return why it was not used, None if it was."""

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update and its variance as stated before the measurement, 0 if none is stated.

        That of the resistance is a specific force [N/kN] with its variance [(N/kN)^2], the others are speeds [m/s]
        with their variance [(m/s)^2].
        """

    def estimate(self, speed: float) -> EstimateT_co:
        """Return the current estimate at a speed [m/s]."""

    @property
    def converged(self) -> bool:
        """True while the estimate is fit for use."""

    def idle(self, seconds: float) -> None:
        """Widen the uncertainty by what may have changed in a time without samples [s]."""

    def reset(self) -> None:
        """Return to the prior."""

    def save(self) -> str:
        """Return the complete state as JSON text."""

    def restore(self, text: str) -> None:
        """Restore a state made by :meth:`save`; raise InputError if it does not fit."""

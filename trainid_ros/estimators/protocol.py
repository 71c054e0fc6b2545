# SPDX-License-Identifier: Apache-2.0
"""What every estimator offers its drivers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from trainid_ros.core.results import Rejection
    from trainid_ros.core.samples import Sample

EstimateT_co = TypeVar('EstimateT_co', covariant=True)


class Estimator(Protocol[EstimateT_co]):
    """A streaming estimator: explicit state, one step per sample, an estimate or a refusal."""

    def step(self, sample: Sample) -> EstimateT_co | Rejection:
        """Take one sample in; return the estimate, or why the sample was not used."""

    def estimate(self, speed: float) -> EstimateT_co:
        """Return what is believed now, at a speed [m/s]."""

    @property
    def converged(self) -> bool:
        """True while the estimate is fit to use."""

    def reset(self) -> None:
        """Go back to the prior."""

    def save(self) -> str:
        """Return the whole state as JSON text."""

    def restore(self, text: str) -> None:
        """Take over a state made by :meth:`save`; InputError if it does not fit."""

# SPDX-License-Identifier: Apache-2.0
"""What the hidden cases of every generator have in common as input of the workflow."""

from __future__ import annotations

import numpy as np

from benchmarks.hidden_case import Case
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, SpeedRecord
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import parse_train_file


def check_usable(case: Case, name: str) -> None:
    """Check train file, truth and records of a case with the effects of a name."""
    assumed = parse_train_file(case.train_yaml, 'assumed train file')
    assert not assumed.effects
    assert [effect.name for effect in case.answer.effects] == ([] if name == 'none' else name.split('+'))
    assert np.isfinite(case.answer.visible)
    for bag in case.bags:
        stamps = [record.stamp_ns for record in bag]
        assert stamps == sorted(stamps)
        kinds = {type(record) for record in bag}
        assert {SpeedRecord, ForceRecord, GradientRecord, BrakeRecord} <= kinds
        assert (MassRecord in kinds) == ('no_mass_topic' not in case.answer.flags)
        assert all(record.target_acceleration <= 0.0 for record in bag if isinstance(record, BrakeRecord))
        assert all(record.speed >= 0.0 for record in bag if isinstance(record, SpeedRecord))


def aligned_share(case: Case) -> float:
    """Return samples over speeds of the first bag."""
    aligner, bag = Aligner(AlignmentConfig()), case.bags[0]
    samples = sum(isinstance(event, Sample) for record in bag for event in aligner.push(record))
    return samples / sum(isinstance(record, SpeedRecord) for record in bag)

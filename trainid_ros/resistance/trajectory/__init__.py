# SPDX-License-Identifier: Apache-2.0
"""Davis parameters from a fit to the whole speed trajectory, after Xia, Li and Sun 2023 (TBRPI-SF).

The paper steps in distance; its formulation, for comparison, is in ``lab/``. Here the steps are in *time*, for bags at
5 Hz and for records every 100 m: both have time stamps. Time steps need no position and have no 1/v at a stop, and the
exact balance over an interval holds for the time-mean force, which the aligned samples contain. Distance steps computed
from measured speeds would bring their noise into the model.
"""

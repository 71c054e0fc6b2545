# SPDX-License-Identifier: Apache-2.0
"""Davis parameters from the whole speed trajectory, after Xia, Li and Sun 2023 (TBRPI-SF).

Two formulations live here. The paper's, in distance (:mod:`stages`, :mod:`derivatives`, :mod:`newton`), with its
errors corrected, is what the experiments of the paper need. What the product uses steps in *time* (:mod:`pieces`,
:mod:`davis_fit`, :mod:`two_window`), for bags at 5 Hz and for records every 100 m alike: both carry stamps. Time
needs no position, has no 1/v at a stop, and the exact balance over an interval holds for the mean force in time,
which is what the aligned samples carry. Distance steps made of measured speeds would put their noise into the model.
"""

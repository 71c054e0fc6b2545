# SPDX-License-Identifier: Apache-2.0
"""Davis parameters from a fit to the whole speed trajectory, after Xia, Li and Sun 2023 (TBRPI-SF).

There are two formulations. The paper's, in distance (:mod:`stages`, :mod:`derivatives`, :mod:`newton`), with its
errors corrected, is for the paper's experiments. The estimators step in *time* (:mod:`pieces`, :mod:`davis_fit`,
:mod:`two_window`), for bags at 5 Hz and for records every 100 m: both have time stamps. Time steps need no position
and have no 1/v at a stop, and the exact balance over an interval holds for the time-mean force, which the aligned
samples contain. Distance steps computed from measured speeds would bring their noise into the model.
"""

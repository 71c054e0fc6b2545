# SPDX-License-Identifier: Apache-2.0
"""Davis parameters from a fit to the speed trajectory in distance, as printed by Xia, Li and Sun 2023 (TBRPI-SF).

The errors of the paper are corrected, see :mod:`stages`; :mod:`newton` and :mod:`levenberg`
minimise. The estimators step in time instead, see :mod:`trainid_ros.resistance.davis_fit`.
"""

# SPDX-License-Identifier: Apache-2.0
"""Streaming estimators: V-MILS (resistance), AM-VFF-RLS (speed model), GSMA (brake rate)."""

# SPDX-License-Identifier: Apache-2.0
"""Inputs from topics, fields and units of others: what a mapping file says, and how messages become records."""

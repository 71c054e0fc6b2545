# SPDX-License-Identifier: Apache-2.0
"""Inputs from topics, fields, units and files of others: mapping files, tables, and suggested mappings."""

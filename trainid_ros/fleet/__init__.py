# SPDX-License-Identifier: Apache-2.0
"""A fleet of trains: one row of estimates per bag, and which train stands out."""

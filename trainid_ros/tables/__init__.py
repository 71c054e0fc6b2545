# SPDX-License-Identifier: Apache-2.0
"""Tables of others as input, and estimates as tables: CSV, Parquet, npz."""

# SPDX-License-Identifier: Apache-2.0
"""Automatic train operation that stops by what is known of the train, and days on which that can be compared."""

# SPDX-License-Identifier: Apache-2.0
"""What all else builds on: records, messages, results and their states, errors, text."""

# SPDX-License-Identifier: Apache-2.0
"""Shared types: records, aligned samples, results and errors. No ROS, no file formats."""

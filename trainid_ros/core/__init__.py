# SPDX-License-Identifier: Apache-2.0
"""What every part shares: records, aligned samples, results, errors. No ROS, no files."""

# SPDX-License-Identifier: Apache-2.0
"""Train simulator with known truth: plant, driver, sensors, scenarios. No ROS, no files but the truth."""

# SPDX-License-Identifier: Apache-2.0
"""Train simulator with known true values: plant, driver, sensors, scenarios. No ROS; the only file is the truth."""

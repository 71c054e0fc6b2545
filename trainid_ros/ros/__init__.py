# SPDX-License-Identifier: Apache-2.0
"""ROS 2 lifecycle nodes around the estimators; the only place that imports rclpy."""

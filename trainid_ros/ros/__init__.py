# SPDX-License-Identifier: Apache-2.0
"""ROS 2 lifecycle nodes around the estimators; only cli imports rclpy besides."""

# SPDX-License-Identifier: Apache-2.0
"""Reading and writing rosbag2 bags (MCAP) without ROS."""

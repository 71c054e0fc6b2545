# SPDX-License-Identifier: Apache-2.0
"""What ``trainid monitor`` shows: from messages and times to views, from views to a screen or to lines; without ROS."""

# SPDX-License-Identifier: Apache-2.0
"""Settings of the three estimators, from files and parameters, without ROS; and the pipelines that they make."""

# SPDX-License-Identifier: Apache-2.0
"""Start-up hook of the project's virtual environment: lets ROS find the packages installed in it."""

import os
import sys

_prefixes = [item for item in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if item]
if sys.prefix not in _prefixes:
    os.environ['AMENT_PREFIX_PATH'] = os.pathsep.join([*_prefixes, sys.prefix])

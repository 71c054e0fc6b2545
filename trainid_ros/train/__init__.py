# SPDX-License-Identifier: Apache-2.0
"""Train, line, resistance and brake actuator: the physics shared by simulator and estimators."""

# SPDX-License-Identifier: Apache-2.0
"""Running resistance: Davis parameters from speed, force and gradient."""

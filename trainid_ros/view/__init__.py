# SPDX-License-Identifier: Apache-2.0
"""A replay as a recording for the Rerun viewer: inputs, estimates, status and events on one time axis."""

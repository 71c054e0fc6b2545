# SPDX-License-Identifier: Apache-2.0
"""Contents of a bag, whether it can be used, and the mapping that it needs."""

# SPDX-License-Identifier: Apache-2.0
"""What is in a bag, whether it can be used, and the mapping that it needs."""

# SPDX-License-Identifier: Apache-2.0
"""Speed model x(n) = a1 x^2 + a2 x + b1 u + d0."""

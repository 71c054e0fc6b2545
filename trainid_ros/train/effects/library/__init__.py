# SPDX-License-Identifier: Apache-2.0
"""Built-in effects, one module each; every module defines ``EFFECT``."""

# SPDX-License-Identifier: Apache-2.0
"""From records to samples: sensor correction, alignment by stamp, drive history, checks of the inputs."""

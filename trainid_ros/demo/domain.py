# SPDX-License-Identifier: Apache-2.0
"""Select an unused ROS domain and restrict it to this machine."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING, Final

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

# From the RTPS specification: ports of a domain and of its first participants.
_BASE_PORT: Final = 7400
_PORTS_OF_DOMAIN: Final = 250
_OFFSETS: Final = (0, 10, 11, 12, 13)
# ROS recommends domains up to 101; 0 is the default of all processes.
_DOMAINS: Final = 101
# Fast DDS drops what does not fit into its shared memory, and resending takes long at many times real time.
# These queues hold the messages of a process stalled for seconds. Other middlewares do not read this profile.
_PROFILE: Final = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com"><profiles>
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>deep_memory</transport_id><type>SHM</type>
      <segment_size>33554432</segment_size><port_queue_capacity>32768</port_queue_capacity>
    </transport_descriptor>
    <transport_descriptor><transport_id>udp</transport_id><type>UDPv4</type></transport_descriptor>
  </transport_descriptors>
  <participant profile_name="demo" is_default_profile="true"><rtps>
    <useBuiltinTransports>false</useBuiltinTransports>
    <userTransports>
      <transport_id>deep_memory</transport_id><transport_id>udp</transport_id>
    </userTransports>
  </rtps></participant>
</profiles></dds>
"""


def free_domain(first: int) -> int:
    """Return a domain whose ports are all free, searching from ``first``.

    Raises:
        InputError: All are in use.

    """
    for step in range(_DOMAINS):
        domain = 1 + (first + step) % _DOMAINS
        if _are_free(_BASE_PORT + _PORTS_OF_DOMAIN * domain + offset for offset in _OFFSETS):
            return domain
    msg = f'ROS_DOMAIN_ID: all domains from 1 to {_DOMAINS} are in use'
    raise InputError(msg)


def _are_free(ports: Iterable[int]) -> bool:
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', port))
            except OSError:
                return False
    return True


def isolate(logs: Path) -> int:
    """Put this process and its children into an unused domain; return it."""
    domain = free_domain(os.getpid())
    profile = logs / 'fastdds.xml'
    profile.write_text(_PROFILE, encoding='utf-8')
    os.environ |= {
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile.absolute()),
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_LOG_DIR': str(logs.absolute()),
    }
    # This older switch would disable the range above.
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    os.environ.pop('ROS_STATIC_PEERS', None)
    return domain

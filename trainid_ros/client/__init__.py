# SPDX-License-Identifier: Apache-2.0
"""What an autopilot asks: resistance, force, brake rate and stopping distance of today's train, each with its std.

    from trainid_ros.client import TrainModel

    train = TrainModel(node, 'train.yaml')
    force = train.feed_forward(speed, gradient, acceleration).value
    limit = train.braking_speed(distance_to_stop, gradient, command=-0.8).value

Importing starts nothing and needs no ROS.
"""

from trainid_ros.client.train_model import TrainModel, Value

__all__ = ['TrainModel', 'Value']

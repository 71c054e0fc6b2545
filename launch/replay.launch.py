# SPDX-License-Identifier: Apache-2.0
"""Play a bag through the three estimators on simulated time."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

SWITCH = ('true', 'false', 'True', 'False', '1', '0')


RATES = (0.01, 1000.0)


def check(context):
    """Refuse what the player would refuse before anything has started; without a player the others would wait."""
    rate = LaunchConfiguration('rate').perform(context)
    try:
        is_valid = RATES[0] <= float(rate) <= RATES[1]
    except ValueError:
        is_valid = False
    if not is_valid:
        raise RuntimeError(f'rate:={rate} must be a number from {RATES[0]:g} to {RATES[1]:g}')
    for name in ('bag', 'train_file', 'mapping_file'):
        path = LaunchConfiguration(name).perform(context)
        if not Path(path).exists() and (path or name != 'mapping_file'):
            raise RuntimeError(f'{name}:={path} does not exist')
    return []


def generate_launch_description():
    """Return what ``ros2 launch trainid_ros replay.launch.py bag:=... train_file:=...`` starts."""
    arguments = (
        ('bag', 'rosbag2 directory, .mcap or .db3 file', None),
        ('train_file', 'train file (YAML)', None),
        ('mapping_file', 'mapping file (YAML): inputs from other topics, types and units', ''),
        ('rate', 'recorded seconds per second', '1.0'),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        if value is not None
        else DeclareLaunchArgument(name, description=text)
        for name, text, value in arguments
    ]
    loop = DeclareLaunchArgument('loop', default_value='false', description='start over at the end', choices=SWITCH)
    estimators = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(Path(__file__).with_name('trainid.launch.py'))),
        launch_arguments={
            'train_file': LaunchConfiguration('train_file'),
            'mapping_file': LaunchConfiguration('mapping_file'),
            'use_sim_time': 'true',
        }.items(),
    )
    player = LifecycleNode(
        package='trainid_ros',
        executable='bag_player',
        name='bag_player',
        namespace='',
        parameters=[
            {
                'bag': LaunchConfiguration('bag'),
                'mapping_file': LaunchConfiguration('mapping_file'),
                'rate': ParameterValue(LaunchConfiguration('rate'), value_type=float),
                'loop': ParameterValue(LaunchConfiguration('loop'), value_type=bool),
                'wait': 3,
                'autostart': True,
            }
        ],
        output='screen',
    )
    return LaunchDescription([*declared, loop, OpaqueFunction(function=check), estimators, player])

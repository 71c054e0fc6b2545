# SPDX-License-Identifier: Apache-2.0
"""Start the three estimators as lifecycle nodes that configure and activate themselves."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

from launch import LaunchDescription

SWITCH = ('true', 'false', 'True', 'False', '1', '0')
LOG_LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
NODES = ('resistance_estimator', 'speed_model_estimator', 'brake_rate_estimator')


def make_nodes(context):
    """Return the nodes; the autostart of launch_ros is not used, the nodes have their own."""
    values = {
        name: LaunchConfiguration(name).perform(context)
        for name in (
            'train_file',
            'mapping_file',
            'params_file',
            'use_sim_time',
            'autostart',
            'namespace',
            'log_level',
            'checkpoint_folder',
        )
    }
    parameters = [
        {
            'use_sim_time': values['use_sim_time'].lower() in {'true', '1'},
            'autostart': values['autostart'].lower() in {'true', '1'},
        }
    ]
    if values['params_file']:
        parameters.insert(0, values['params_file'])
    if values['train_file']:
        parameters.append({'train_file': values['train_file']})
    if values['mapping_file']:
        parameters.append({'mapping_file': values['mapping_file']})
    return [
        LifecycleNode(
            package='trainid_ros',
            executable=name,
            name=name,
            namespace=values['namespace'],
            parameters=[*parameters, *checkpoint_of(name, values['checkpoint_folder'])],
            ros_arguments=['--log-level', values['log_level']],
            output='screen',
            respawn=True,
            respawn_delay=2.0,
        )
        for name in NODES
    ]


def checkpoint_of(name, folder):
    """Return the parameters that give a node its checkpoint file."""
    return [{'checkpoint_file': f'{folder}/{name}.json'}] if folder else []


def generate_launch_description():
    """Return what ``ros2 launch trainid_ros trainid.launch.py`` starts."""
    arguments = (
        ('train_file', '', 'train file (YAML); its values are the defaults of train.*, resistance.* and brake.*', None),
        ('mapping_file', '', 'mapping file (YAML): inputs from other topics, types and units', None),
        ('params_file', '', 'parameter file, see config/params.yaml', None),
        ('use_sim_time', 'false', 'true while a bag or a simulator publishes /clock', SWITCH),
        ('autostart', 'true', 'false leaves configuring and activating to a lifecycle manager', SWITCH),
        ('namespace', '', 'namespace of nodes and topics, for more than one train', None),
        ('checkpoint_folder', '', 'folder of the checkpoints, a file for each node; empty: none are kept', None),
        ('log_level', 'info', 'least important messages to log', LOG_LEVELS),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text, choices=choices)
        for name, value, text, choices in arguments
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=make_nodes)])

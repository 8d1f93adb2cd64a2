"""Run `pumafuse live` as a node, by a folder that `pumafuse fuse BAG -o FOLDER` wrote.

ros2 launch pumafuse.launch.py folder:=mine [name:=pumafuse] [frame_id:=base_link] [use_sim_time:=true]
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "folder": (None, "With run.toml and fusion.toml"),
    "name": ("pumafuse", "Of the node; estimates are at /NAME/pose, /NAME/joints and /NAME/diagnostics"),
    "frame_id": ("", "Of the poses; as default that of the commands"),
    "use_sim_time": ("false", "Whether time is that of /clock"),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the process."""
    folder, name, frame_id, use_sim_time = map(LaunchConfiguration, ARGUMENTS)
    command = ["pumafuse", "live", ["ros2:", folder, "/run.toml"], "-c", [folder, "/fusion.toml"], "--ros-args"]
    command += ["-r", ["__node:=", name], "-p", ["frame_id:='", frame_id, "'"], "-p", ["use_sim_time:=", use_sim_time]]
    declared = [
        DeclareLaunchArgument(key, default_value=default, description=what)
        for key, (default, what) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, ExecuteProcess(cmd=command, output="screen")])

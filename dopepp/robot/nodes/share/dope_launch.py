"""ROS 2: `ros2 launch dope_launch.py model:=best_tuned.ckpt topic:=/camera/image_raw`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "model": ("pretrained/pivconnector", "checkpoint (best.ckpt of a run) or released network"),
    "topic": ("/camera/image_raw", "topic of the images"),
    "name": ("dope", "name of the node"),
    "params": (__file__.replace("_launch.py", ".yaml"), "YAML file of parameters"),
}


def generate_launch_description() -> LaunchDescription:
    """Return a launch description that starts a node and restarts it when it exits."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in ARGUMENTS.items()
    ]
    words = ["dopepp", "node", LaunchConfiguration("model"), "--ros2"]
    for name in ("topic", "name", "params"):
        words += [f"--{name}", LaunchConfiguration(name)]
    node = ExecuteProcess(cmd=words, output="screen", respawn=True, respawn_delay=1.0)
    return LaunchDescription([*arguments, node])

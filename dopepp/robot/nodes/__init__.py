"""The node: poses of what a robot's camera sees, over ROS 2, bags, UDP and stdout.

:mod:`.worker` does the work, :mod:`.messages` says it in ROS's words; each other module is one way
in and out. To add one, hand pictures to a :class:`.worker.Worker` and its answers on.
"""

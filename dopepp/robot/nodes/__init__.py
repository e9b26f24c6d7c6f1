"""The node: estimates poses in camera images and sends them by ROS 2, bags, UDP or stdout.

:mod:`.worker` estimates the poses and :mod:`.messages` converts them to ROS messages. The other
modules are transports. To add a transport, pass images to a :class:`.worker.Worker` and send the
answers.
"""

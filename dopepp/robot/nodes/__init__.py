"""The node: poses in the images of a robot's camera, over ROS 2, bags, UDP and stdout.

:mod:`.worker` estimates the poses and :mod:`.messages` converts them to ROS messages. The other
modules are transports. To add a transport, pass images to a :class:`.worker.Worker` and send the
answers.
"""

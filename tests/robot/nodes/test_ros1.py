"""Messages of ROS 1, where its Python packages are."""

import pytest

pytest.importorskip("genpy", reason="needs ROS 1's genpy and messages")
pytest.importorskip("geometry_msgs.msg")

from dopepp.robot.nodes.messages import Speaker, diagnosis
from dopepp.robot.nodes.native import native
from dopepp.robot.nodes.worker import Stamp


def test_messages_are_filled_by_their_own_types(estimator, seen, messages):
    from dopepp.robot.nodes.worker import Worker

    info = messages.info(seen.K, (320, 240))
    answer = Worker(estimator).take(messages.image(seen.pictures[0], 7.5), info, messages.topic)
    speaker = Speaker(estimator.solid_parts)
    for one in speaker.messages(answer, lambda topic: topic != "detections"):
        message = native(one.kind, one.fields)
        message._check_types()
        if hasattr(message, "header"):
            assert message.header.stamp.to_sec() == 7.5
    said = diagnosis(Stamp(3, 4), "dope", "oh", {"rate": "30"})
    assert native(said.kind, said.fields).status[0].level == 1

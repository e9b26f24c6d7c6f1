"""An arm, its gripper and trials with exact poses, made once."""

import numpy as np
import pytest

from dopepp.parts.catalogue import load_part
from dopepp.robot.grasping.grasp_trial import GraspTask, PoseSource, Trials
from dopepp.robot.grasping.planner import Arm, measure_gripper


@pytest.fixture(scope="session")
def arm():
    return Arm()


@pytest.fixture(scope="session")
def gripper():
    return measure_gripper()


@pytest.fixture(scope="session")
def part():
    return load_part("pivconnector")


@pytest.fixture(scope="session")
def trials():
    return Trials(GraspTask(sources=(PoseSource("exact"),)))


@pytest.fixture(scope="session")
def scene(trials):
    return trials.scene(0)


@pytest.fixture
def straight_down():
    return np.diag([1.0, -1.0, -1.0, 1.0])

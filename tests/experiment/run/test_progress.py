import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.run.train import _progress
from dopepp.training.refined_progress import RefinedProgress


def test_refined_poses_are_measured_where_they_are_verified(tiny):
    config = tiny("experiment=quickstart", "stop_at=0.9", "data.num_val=3")
    (progress,) = _progress(config, build_parts(config.data))
    assert isinstance(progress, RefinedProgress)
    assert (progress.stop_at, len(progress.pictures)) == (0.9, 3)


@pytest.mark.parametrize("refine", ["null", "depth"])
def test_a_goal_needs_verified_poses(tiny, refine):
    config = tiny("experiment=quickstart", "stop_at=0.9", f"refine={refine}")
    with pytest.raises(UserError, match=r"stop_at=0\.9 with refine=") as error:
        _progress(config, build_parts(config.data))
    assert "refine=region" in error.value.fix
    without = tiny("experiment=quickstart", f"refine={refine}")
    assert _progress(without, build_parts(without.data)) == []


def test_a_goal_is_a_share(tiny):
    with pytest.raises(UserError, match="stop_at"):
        tiny("stop_at=1.5")

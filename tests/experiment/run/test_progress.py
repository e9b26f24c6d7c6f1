import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.run.train import _progress
from dopepp.training.refined_progress import RefinedProgress


def progress_of(config):
    return _progress(config, build_datamodule(config.data, build_parts(config.data), config.seed))


def test_verified_refined_poses_are_measured_during_training(tiny):
    config = tiny("experiment=quickstart", "stop_at=0.9", "data.num_val=3")
    (progress,) = progress_of(config)
    assert isinstance(progress, RefinedProgress)
    assert (progress.stop_at, len(progress.images)) == (0.9, 3)


@pytest.mark.parametrize("refine", ["null", "depth"])
def test_stop_at_needs_verified_poses(tiny, refine):
    config = tiny("experiment=quickstart", "stop_at=0.9", f"refine={refine}")
    with pytest.raises(UserError, match=r"stop_at=0\.9 with refine=") as error:
        progress_of(config)
    assert "refine=region" in error.value.fix
    without = tiny("experiment=quickstart", f"refine={refine}")
    assert progress_of(without) == []


def test_progress_is_measured_on_whole_images(tiny, tmp_path):
    camera = tmp_path / "cam.yaml"
    camera.write_text(
        "image_width: 320\nimage_height: 240\ncamera_matrix: {rows: 3, cols: 3, "
        "data: [300, 0, 159.5, 0, 300, 119.5, 0, 0, 1]}\n"
    )
    seen = ("experiment=my_part", f"virtual.camera={camera}", "virtual.working_distance=[0.3,0.5]")
    config = tiny(*seen, "data.input_size=[128,128]", "data.symmetries=none")
    data = fit_to_camera(config, parts := build_parts(config.data)).data
    datamodule = build_datamodule(data, parts, config.seed)
    (progress,) = _progress(config, datamodule)
    assert progress.images.sample(0).image.shape == (240, 320, 3)
    assert datamodule.val_source.sample(0).image.shape == (128, 128, 3)

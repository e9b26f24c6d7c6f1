"""Equal images have equal target maps; at the border of a sector, the network chooses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.data.batch import PADDING, Batch
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.symmetry import symmetry_group
from dopepp.maps.codec import MapGeometry
from dopepp.parts.part import Part
from dopepp.training.targets import FACING, SymmetryHandling, SymmetryOptions, draw_maps

K = camera_matrix(110.0, 110.0, 63.5, 63.5)
HALF_TURNS = np.stack([np.diag(d) for d in ([1.0, -1, -1, 1], [-1, 1, -1, 1], [-1, -1, 1, 1])])
AXIS = ((0.0, 0.0, 1.0), (0.01, 0.02, 0.0))
FLIP = make_transform(np.diag([1.0, -1, -1]), np.array([0.0, 0.04, 0.0]))


def make_part(name, centre, **symmetries):
    half = np.array([0.05, 0.03, 0.01])
    cuboid = cuboid_keypoints(np.array(centre) - half, np.array(centre) + half)
    return Part(name, cuboid, 0.118, cuboid, **symmetries)


PLAIN = make_part("plain", (0, 0, 0))
PLATE = make_part("plate", (0, 0, 0), symmetries_discrete=HALF_TURNS)
CONE = make_part("cone", (0.01, 0.02, 0), symmetries_continuous=(AXIS,))
CAN = replace(CONE, name="can", symmetries_discrete=FLIP[None])
ROUND_OR_FLAT = pytest.mark.parametrize("part", [PLATE, CAN, CONE], ids=lambda part: part.name)


def make_batch(poses, part):
    """Return a batch with one instance per image."""
    keypoints = np.stack([project_keypoints(part.cuboid, T, K) for T in poses])
    count = len(poses)
    return Batch(
        images=torch.zeros(count, 3, 128, 128, dtype=torch.uint8),
        K=torch.from_numpy(K).float().expand(count, 3, 3),
        T_cam_obj=torch.from_numpy(poses).float()[:, None],
        keypoints=torch.from_numpy(keypoints).float()[:, None],
        object_index=torch.zeros(count, 1, dtype=torch.long),
        visible_fraction=torch.ones(count, 1),
        keys=[str(number) for number in range(count)],
        sources=["test"] * count,
    )


def random_poses(count, seed):
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, random_state=seed).as_matrix()
    shifts = rng.uniform((-0.1, -0.1, 0.25), (0.1, 0.1, 0.4), (count, 3))
    return np.stack([make_transform(*pair) for pair in zip(rotations, shifts, strict=True)])


def face_on(angles_deg):
    """Poses in the reference orientation, turned in the image plane."""
    turns = Rotation.from_euler("z", np.array(angles_deg)[:, None], degrees=True).as_matrix()
    return np.stack([make_transform(turn @ FACING, (0, 0, 0.3)) for turn in turns])


@ROUND_OR_FLAT
def test_equivalent_poses_have_the_same_keypoints(part):
    handling = SymmetryHandling([part], SymmetryOptions())
    poses = random_poses(40, seed=5)
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous, 0.3)
    expected = handling.equivalents(make_batch(poses, part)).keypoints[:, 0, 0]
    for S in group:
        result = handling.equivalents(make_batch(poses @ S, part)).keypoints[:, 0, 0]
        # Poses exactly on a border have two targets; no random pose is within 1e-4 of a border.
        assert (result - expected).abs().max() < 0.02


@ROUND_OR_FLAT
def test_the_first_choice_is_the_best_of_the_whole_group(part):
    """Brute force over the group in steps of a degree, for parts on the optical axis."""
    handling = SymmetryHandling([part], SymmetryOptions())
    poses = random_poses(20, seed=6)
    fixed = part.cuboid[8]
    poses[:, :3, 3] = (0, 0, 0.3) - poses[:, :3, :3] @ fixed
    result = handling.equivalents(make_batch(poses, part)).keypoints[:, 0, 0].numpy()
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous, np.pi / 360)
    # The axis +z of a round part shall point up in the image, to −y.
    reference = FACING if part is PLATE else np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for T, keypoints in zip(poses, result, strict=True):
        equivalents = T @ group
        score = np.trace(reference.T @ equivalents[:, :3, :3], axis1=1, axis2=2)
        best = project_keypoints(part.cuboid, equivalents[score.argmax()], K)
        assert np.abs(best - keypoints).max() < 0.6


def test_choices_of_a_box_are_permutations_of_its_corners():
    handling = SymmetryHandling([PLATE], SymmetryOptions(border_deg=360))
    batch = make_batch(random_poses(10, seed=7), PLATE)
    result = handling.equivalents(batch)
    assert result.keypoints.shape == (10, 1, 4, 9, 2)
    assert result.allowed.all()
    own = batch.keypoints[:, 0]
    for image in range(10):
        orders = set()
        for keypoints in result.keypoints[image, 0]:
            away = torch.cdist(keypoints, own[image])
            assert away.amin(dim=1).max() < 1e-2
            orders.add(tuple(away.argmin(dim=1).tolist()))
        assert len(orders) == 4
        assert all(sorted(order) == list(range(9)) and order[8] == 8 for order in orders)


def test_parts_without_symmetries_and_padding_keep_their_labels_exactly():
    handling = SymmetryHandling([PLAIN, PLATE], SymmetryOptions(border_deg=360))
    batch = make_batch(random_poses(3, seed=8), PLAIN)
    result = handling.equivalents(batch)
    assert torch.equal(result.keypoints[:, :, 0], batch.keypoints)
    assert result.allowed[..., 0].all()
    assert not result.allowed[..., 1:].any()
    padded = replace(batch, object_index=torch.full((3, 1), PADDING))
    assert not handling.equivalents(padded).allowed[..., 1:].any()
    assert not SymmetryHandling([PLAIN], SymmetryOptions()).active
    assert not SymmetryHandling([PLATE], SymmetryOptions(False, 0.0)).active


def test_the_border_has_the_configured_width():
    """Face on, a plate at θ in the image plane is |θ| and 180° − |θ| from the reference."""
    poses = face_on((0.0, 70.0, 80.0, 95.0, 120.0))
    handling = SymmetryHandling([PLATE], SymmetryOptions(border_deg=30.0))
    allowed = handling.equivalents(make_batch(poses, PLATE)).allowed[:, 0]
    assert allowed[:, 1].tolist() == [False, False, True, True, False]
    assert not allowed[:, 2:].any()


@pytest.fixture
def plate_system(make_system):
    system = make_system()
    system.parts = (PLATE,)
    system.symmetry = SymmetryHandling([PLATE], SymmetryOptions(border_deg=30.0))
    return system


def test_targets_are_the_choice_nearest_to_the_maps(plate_system):
    batch = make_batch(face_on((0.0, 85.0)), PLATE)
    result = plate_system.symmetry.equivalents(batch)
    geometry = plate_system.geometry
    first, second = (draw_maps(batch, result.keypoints[:, :, n], 1, geometry) for n in (0, 1))
    assert not torch.allclose(first[0], second[0])
    for maps in (first, second):
        stages = [(maps[0].clamp(min=1e-9).log(), maps[1])]
        belief, field = plate_system.targets(batch, stages)
        # Far from the border, the network has no influence.
        assert torch.equal(belief[0], first[0][0])
        assert torch.equal(belief[1], maps[0][1])
        assert torch.equal(field[1], maps[1][1])
    assert torch.equal(plate_system.targets(batch)[0], first[0])


def test_instances_of_an_image_are_chosen_independently(plate_system):
    poses = face_on((85.0, -88.0))
    poses[:, :3, 3] = (-0.08, 0, 0.4), (0.08, 0, 0.4)
    alone = make_batch(poses, PLATE)
    both = replace(
        alone.rows(torch.tensor([0])),
        T_cam_obj=alone.T_cam_obj.swapaxes(0, 1),
        keypoints=alone.keypoints.swapaxes(0, 1),
        object_index=torch.zeros(1, 2, dtype=torch.long),
        visible_fraction=torch.ones(1, 2),
    )
    choices = plate_system.symmetry.equivalents(both).keypoints
    for wanted in ((0, 0), (0, 1), (1, 0), (1, 1)):
        keypoints = torch.stack([choices[:, n, choice] for n, choice in enumerate(wanted)], dim=1)
        belief, field = draw_maps(both, keypoints, 1, plate_system.geometry)
        stages = [(belief.clamp(min=1e-9).log(), field)]
        assert torch.equal(plate_system.targets(both, stages)[0], belief)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"border_deg": -1.0}, "border_deg"),
        ({"canonical": False}, "border_deg=30.0 with symmetry.canonical=false"),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(UserError, match=message):
        SymmetryOptions(**options)


def draw(batch, num_objects=1):
    return draw_maps(batch, batch.keypoints, num_objects, MapGeometry(8))


@pytest.mark.parametrize(
    ("visible", "index", "drawn"),
    [((0.0999, 0.1001), (0, 0), [False, True]), ((1.0, 1.0), (0, PADDING), [True, False])],
)
def test_hardly_visible_instances_and_padding_leave_empty_channels(visible, index, drawn, batch):
    changed = replace(
        batch,
        visible_fraction=torch.tensor(visible)[:, None],
        object_index=torch.tensor(index)[:, None],
    )
    for maps in draw(changed):
        assert maps.flatten(1).any(dim=1).tolist() == drawn

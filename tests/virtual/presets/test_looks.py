"""Random light and materials: colours against physics, shares and ranges over many draws."""

from dataclasses import replace

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.virtual import make_surface
from dopepp.virtual.body import Distractors
from dopepp.virtual.presets.looks import Lighting, Materials, black_body_rgb
from dopepp.virtual.presets.placement import (
    DistancePlacement,
    FacingTurning,
    FillPlacement,
    OffsetPlacement,
)
from dopepp.virtual.presets.table import Table


def planck_rgb(temperature):
    """Integrate Planck's law over Wyman, Sloan and Shirley's fits of the CIE 1931 observer."""
    nm = np.arange(380.0, 781.0)

    def lobe(height, centre, left, right):
        scaled = (nm - centre) * np.where(nm < centre, left, right)
        return height * np.exp(-0.5 * scaled**2)

    observer = np.array([
        lobe(1.056, 599.8, 0.0264, 0.0323) + lobe(0.362, 442.0, 0.0624, 0.0374)
        + lobe(-0.065, 501.1, 0.0490, 0.0382),
        lobe(0.821, 568.8, 0.0213, 0.0247) + lobe(0.286, 530.9, 0.0613, 0.0322),
        lobe(1.217, 437.0, 0.0845, 0.0278) + lobe(0.681, 459.0, 0.0385, 0.0725),
    ])  # fmt: skip
    power = nm**-5.0 / (np.exp(1.4387769e7 / (nm * temperature)) - 1)
    x, y, z = observer @ power
    xyz = np.array([x / y, 1.0, z / y])
    # From the primaries' and the white's chromaticities (BT.709), not from a printed matrix.
    corners = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]])
    columns = np.stack([corners[:, 0] / corners[:, 1], np.ones(4),
                        (1 - corners.sum(axis=1)) / corners[:, 1]])  # fmt: skip
    primaries = columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])
    return np.linalg.solve(primaries, xyz)


@pytest.mark.parametrize("temperature", [2700, 4000, 4001, 5000, 6504, 9000, 15000])
def test_black_body_colours_follow_plancks_law(temperature):
    np.testing.assert_allclose(black_body_rgb(temperature), planck_rgb(temperature), atol=0.05)


def test_lights_stand_above_their_plane():
    ranges, rng = Lighting(num_lights=(1, 3)), np.random.default_rng(0)
    normal = np.array([0.3, -0.6, -0.5]) / np.linalg.norm([0.3, -0.6, -0.5])
    centre, counts = np.array([0.0, 0.0, 0.5]), set()
    for _ in range(300):
        lights, ambient = ranges.draw(rng, centre, normal)
        counts.add(len(lights))
        np.testing.assert_allclose(ambient.up, normal)
        for light in lights:
            away = np.array(light.position) - centre
            distance = np.linalg.norm(away)
            assert away @ normal / distance >= np.cos(np.radians(75)) - 1e-9
            assert 0.5 - 1e-9 <= distance <= 2.5 + 1e-9
            assert light.reach == pytest.approx(distance)
    assert counts == {1, 2, 3}


def test_materials_keep_to_their_ranges_and_shares(box_surface):
    ranges = Materials(metal_share=0.3, brushed_share=0.5, print_share=0.6)
    rng = np.random.default_rng(0)
    drawn = [ranges.draw(rng, box_surface) for _ in range(3000)]
    metals, plastics = ([m for m in drawn if bool(m.metallic) == kind] for kind in (True, False))
    assert len(metals) / 3000 == pytest.approx(0.3, abs=0.03)
    assert np.mean([m.grooves is not None for m in metals]) == pytest.approx(0.5, abs=0.06)
    assert np.mean([m.grooves is not None for m in plastics]) == pytest.approx(0.6, abs=0.04)
    for m in drawn:
        assert all(0 <= c <= 1 for c in m.colour)
        assert 0 <= m.noise <= 0.12
    for m in metals:
        assert 0.2 <= m.roughness <= 0.6
        assert m.grooves is None or (m.grooves.irregularity == 1 and m.grooves.pitch <= 5e-4)
    for m in plastics:
        assert 0.25 <= m.roughness <= 0.9
        assert 0.02 <= m.specular <= 0.07
        assert max(m.colour) <= 0.9 * 1.05 + 1e-9
        assert m.grooves is None or 1e-4 <= m.grooves.pitch <= 3e-4
    # The box is thinnest along z, where most prints of it would be built up.
    axes = [m.grooves.axis for m in plastics if m.grooves]
    assert np.mean([axis == (0, 0, 1) for axis in axes]) == pytest.approx(7 / 9, abs=0.05)


def test_textured_surfaces_keep_their_colours(sheet):
    surface = make_surface(sheet(0.1, np.full((4, 4, 3), 99, np.uint8)))
    rng = np.random.default_rng(0)
    for _ in range(100):
        material = Materials(metal_share=1.0).draw(rng, surface)
        assert material.colour[0] == material.colour[1] == material.colour[2]
        assert 0.7 <= material.colour[0] <= 1.2
        assert (material.metallic, material.noise, material.grooves) == (0, 0, None)
    # A tint changes every channel by a share of its own.
    materials = Materials(texture_gain=(1.0, 1.0), texture_tint=0.2)
    colours = np.array([materials.draw(rng, surface).colour for _ in range(2000)])
    assert np.abs(colours - 1).max() <= 0.2
    assert colours.std(axis=0) == pytest.approx(0.2 / np.sqrt(3), rel=0.1)
    assert np.abs(np.corrcoef(colours.T) - np.eye(3)).max() < 0.1


def test_only_coloured_surfaces_have_texture_noise(sheet, box_surface):
    materials = Materials(texture_noise=(1.0, 3.0))
    coloured = make_surface(sheet(0.1, np.full((4, 4, 3), 99, np.uint8)))
    rng = np.random.default_rng(0)
    drawn = [materials.draw(rng, coloured).noise for _ in range(200)]
    assert 1.0 <= min(drawn) < 1.1 < 2.9 < max(drawn) <= 3.0
    assert all(materials.draw(rng, box_surface).noise <= 0.12 for _ in range(200))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Materials(metal_share=1.5),
        lambda: Materials(layer_pitch=(float("nan"), 1e-4)),
        lambda: Materials(albedo=(0.1,)),
        lambda: Lighting(temperature_k=(500, 6500)),
        lambda: Distractors((3, 1)),
        lambda: replace(Table(), tilt_deg=(10**400, 1)),
        lambda: FillPlacement(0.9, 0.6),
        lambda: DistancePlacement(1.0, 0.5),
        lambda: OffsetPlacement(distance=0.1, axial=0.1),
        lambda: FacingTurning(tilt_deg=-1),
    ],
)
def test_wrong_ranges_are_refused(make):
    with pytest.raises(UserError, match=r"allowed: .*fix: (set|lower|raise)"):
        make()

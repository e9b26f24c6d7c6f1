"""Mean position of the part in scenes of the preset ``paper``, without rendering.

python benchmarks/placement.py --scenes 10000
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.presets.placement import OffsetPlacement


class CountedPlacement(OffsetPlacement):
    """Counts the drawn positions, and the positions moved along the optical axis."""

    drawn = moved = 0

    def draw(self, *arguments: object) -> np.ndarray:
        """Draw a position, and count it."""
        CountedPlacement.drawn += 1
        return super().draw(*arguments)

    def redraw(self, *arguments: object) -> np.ndarray:
        """Move a position along the optical axis, and count the move."""
        CountedPlacement.moved += 1
        return super().redraw(*arguments)


def row(part: Part, seed: int, num_scenes: int) -> tuple[str, ...]:
    """Measure one part's scenes."""
    preset = PRESETS["paper"]
    box = preset.placement
    assert isinstance(box, OffsetPlacement)
    counted = CountedPlacement(box.distance, box.axial, box.lateral)
    factory = Factory([part], replace(preset, placement=counted), seed)
    poses, refused, given_up = [], 0, 0
    for index in range(num_scenes):
        CountedPlacement.drawn = CountedPlacement.moved = 0
        poses.append(factory.scene(0, index).objects[0].T_cam_obj)
        refused += CountedPlacement.moved > 0
        given_up += CountedPlacement.drawn > 1
    T = np.array(poses)
    x, y, z = 100 * np.abs(T[:, :3, 3]).mean(axis=0)
    near = 100 * (T[:, 2, 3] < box.distance).mean()
    upright = np.abs(T[:, 2, 2]).mean()
    values = (f"{v:.2f}" for v in (x, y, z))
    shares = (f"{near:.1f}", f"{100 * refused / num_scenes:.1f}")
    return part.name, *values, *shares, str(given_up), f"{upright:.3f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=10_000)
    options = parser.parse_args()
    head = ("part", "|x| cm", "|y| cm", "z cm", "nearer %", "refused %", "given up", "|R_zz|")
    print("".join(f"{word:>14}" for word in head))
    for part in (servoholder(), pivconnector()):
        print("".join(f"{value:>14}" for value in row(part, options.seed, options.scenes)))


if __name__ == "__main__":
    main()

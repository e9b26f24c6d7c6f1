"""What pyproject.toml cannot say: ``conf/`` of the repository is ``dopepp/conf`` of the wheel."""

from setuptools import find_namespace_packages, setup

setup(
    packages=[*find_namespace_packages(include=["dopepp*", "hydra_plugins*"]), "dopepp.conf"],
    package_dir={"dopepp.conf": "conf"},
    include_package_data=False,  # only what stands here, whatever version control knows
    package_data={
        "dopepp": [
            "py.typed",
            "experiment/results/templates/*",
            "inference/refinement/verification.json",
            "inference/templates/ranking.json",
            "parts/convex/*.npz",
            "pretrained/*",
            "pretrained/start/*",
            "robot/grasping/data/*",
            "robot/nodes/share/*",
            "virtual/backgrounds/photos/*",
        ],
        "dopepp.conf": ["**/*.yaml"],
    },
)
